"""The density of rates that are not Gaussian, by expectation propagation (EP); see `ep`."""

import numpy as np

from trustbo.inference import ep
from trustbo.inference.columns import Columns
from trustbo.inference.density import Density, Outer
from trustbo.inference.engine import Fit, Prior, evidence, expected
from trustbo.models.families import Family
from trustbo.statespace.blocks import Layout

_SWEEPS = 1
"""Number of EP sweeps at each point for an evidence, beginning with the sites at the mode."""
_LAST_SWEEPS = 2
"""The same, for coefficients where those of the sites at the mode give uneven weights."""
_SETTLED = 12
"""Largest number of EP sweeps that find the sites at the mode."""
_STEADY = 1e-3
"""Relative change of the sites in a sweep below which the sweeps end."""
_DAMPING = 0.7
"""Damping of the EP sweeps that find the sites at the mode."""


class ByEP(Density):
    """Density of rates of any family at points.

    It is that of EP near the point of `run_ep`, in the approximation of `ep.nearby`.

    Attributes:
        rates: Rates in blocks, with their family.
        sites: EP sites at the point of `run_ep`.
        near: The same sites, from which those at other points follow.
    """

    is_gaussian = False
    near: ep.Nearby

    def __init__(self, columns: Columns, layout: Layout, likelihood: Family) -> None:
        """See `Density`."""
        super().__init__(columns, layout, likelihood)
        y = layout.rows(self.observations.contact_rate)
        self.rates = ep.Rates(likelihood, y, layout.rows(self.observations.n_ticks))
        self.reset_ep()

    def reset_ep(self) -> None:
        """Forget the EP sites, so that results do not depend on earlier computations."""
        self.sites = ep.first_sites(self.rates)

    def run_ep(self, outer: Outer) -> None:
        """Find the EP sites at a point, which determine those at other points."""
        if not hasattr(self, "blocks"):
            self.prepare(outer)
        joint = self.joint(outer)
        for _ in range(_SETTLED):
            before = self.sites
            self.sites = ep.swept(joint, before, 1, _DAMPING)
            if self.sites.close_to(before, _STEADY):
                break
        self.near = ep.Nearby.from_sites(joint, self.sites)

    def sites_at(self, outer: Outer) -> ep.Sites:
        """Find the EP sites at each point; they are 0 where the density is 0."""
        shape = (len(outer.log_p), *self.rates.y.shape)
        found = ep.Sites(np.zeros(shape), np.zeros(shape))
        with np.errstate(all="ignore"):  # as in `log_density`
            for index, part in self.chunks(outer):
                sites = ep.swept(self.joint(part), self.sites, _LAST_SWEEPS)
                for values, one in zip(found, sites, strict=True):
                    values[index] = one
        return found

    def log_evidence(self, outer: Outer) -> np.ndarray:
        """See `Density.log_evidence`; here, EP is run at each point."""
        log_p = np.full(len(outer.log_p), -np.inf)
        for index, part in self.chunks(outer):
            joint = self.joint(part)
            log_p[index] = ep.log_evidence(joint, ep.swept(joint, self.sites, _SWEEPS))
        return log_p

    def log_joint(
        self,
        outer: Outer,
        c: np.ndarray,
        rng: np.random.Generator,
        sites: ep.Sites | None = None,
    ) -> np.ndarray:
        """Estimate the log joint density (draw,) of points, coefficients and rates.

        The linear predictors are drawn and weighted, so that the mean of the estimated densities is
        exact.

        Args:
            outer: What the model says at the points (draw,), which must be possible.
            c: Coefficients (draw, column).
            rng: Random number generator.
            sites: EP sites at each draw, by default those near the point of `run_ep`. The better
                they are, the more even are the weights.
        """
        log_p = np.empty(len(c))
        for index, part in self.chunks(outer):
            joint = self.joint(part)
            mean = expected(self.blocks, joint.predictor, c[index])
            if sites is None:
                here, _ = self.near.at(self.rates, joint.predictor.noise_sd)
            else:
                here = sites.of(index)
            _, log_block = ep.draw_predictors(joint, mean, here, rng)
            log_p[index] = part.log_p + joint.prior.log_density(c[index]) + log_block.sum(1)
        return log_p

    def fitted(self, outer: Outer, sites: ep.Sites | None = None) -> tuple[Fit, Prior]:
        """See `Density.fitted`.

        With the sites of `sites_at`, the coefficients are closer to the posterior; the evidence is
        then that of rates equal to the sites.
        """
        joint = self.joint(outer)
        if sites is None:
            fit = ep.nearby(joint, self.near)
        else:
            fit = evidence(self.blocks, joint.predictor, joint.prior, sites.lam, sites.y)
        return fit, joint.prior

    def joint(self, outer: Outer) -> ep.Joint:
        """Return the blocks, linear predictors, prior and rates at each point."""
        return ep.Joint(self.blocks, *self.given(outer), self.rates)
