"""Other tools on our trust models, for `inference.py`; each module needs the tool it is named for.

The function `samplers` of a module makes samplers by name, for some data. A sampler takes a seed.
It returns draws of the parameters by name, with leading axes (chain, draw), and the number of
divergences. It is compiled, and has run once.
"""
