"""The linear Gaussian state-space form of trust, from which all computations derive.

    d_k = A d_{k-1} + u_k + w_k,    w_k ~ N(0, Q),    d_0 ~ N(m0, P0)    state
    x_k = d_k + o_k                                                      trust
    f_k = x_k + v_k,                v_k ~ N(0, R)                        linear predictor
    y_k ~ likelihood(f_k, sd)                                            contact rate

The input of a bound is either carried over to later bounds (u, a drift) or not (o, an offset).

`form` contains the parameters A, Q, m0, P0, R and sd, `kalman` contains the recursion over bounds,
and `blocks` contains the joint normal distribution of all bounds. Models define the parameters and
the inputs.
"""

from trustbo.statespace.form import Inputs, StateSpace

__all__ = ["Inputs", "StateSpace"]
__dir__ = __all__.copy  # tab completion lists only public names
