"""Registration without a start, of clouds that share no point: `register_global`.

Every stage is dense and of a fixed shape: products of (n, n) matrices instead of neighbour lists,
one hypothesis from each of the clearest candidates instead of sampling, a grid instead of a tree.
"""
