"""numpyro, whole.

arviz_base leaves a lazy numpyro in `sys.modules`. Whoever then imports a submodule of it first, as
in `import arviz; import numpyro.distributions`, gets packages that miss their own submodules, and
numpyro fails ("numpyro.distributions has no attribute 'distribution'"). To ask the package for
something first avoids it; where it has happened already, the submodules are put in their places.
"""

import sys

import numpyro

NUMPYRO_VERSION: str = numpyro.__version__

for _name, _module in list(sys.modules.items()):
    _package, _, _child = _name.rpartition(".")
    if _package.startswith("numpyro") and not hasattr(sys.modules[_package], _child):
        setattr(sys.modules[_package], _child, _module)
