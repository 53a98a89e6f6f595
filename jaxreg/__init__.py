"""jaxreg: rigid point cloud registration in pure JAX."""
