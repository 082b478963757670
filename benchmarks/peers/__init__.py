"""Samplers of other libraries for our trust models; each module needs the library in its name.

The function `samplers` of a module returns samplers for given data, keyed by name. A sampler takes
a seed. It returns the draws of each parameter, with the leading axes (chain, draw), and the number
of divergences. It has been compiled and has run once.

Two modules have no samplers: `every_path` and `networkx_planner` find the best path without the
searches of trustbo.
"""
