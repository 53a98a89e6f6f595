"""Pose graphs: the poses of many scans from the registrations of pairs, some of which are wrong.

`pose_graph` has the record and the cost, `optimize` the pure JAX solver for `jit` and derivatives,
`sparse` the solver on the host for thousands of poses, `trees` the start and the check of cycles;
the exponential map and its derivatives are in `jaxreg.geometry.se3`.
"""
