"""Pose graphs: the poses of many scans from the registrations of pairs, some of which are wrong.

`se3` has the exponential map and its derivatives, `pose_graph` the record and the cost, `optimize`
the pure JAX solver for `jit` and derivatives, `sparse` the solver on the host for thousands of
poses, `trees` the start and the check of cycles.
"""
