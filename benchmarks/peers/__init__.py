"""Other tools on our trust models, for `inference.py`; each module needs the tool it is named for.

A peer is a function that makes a sampler of some data; a sampler takes a seed and returns draws of
the parameters by name, with leading axes (chain, draw), and the number of divergences. Samplers are
compiled, and have run once.
"""
