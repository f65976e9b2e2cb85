import numpy as np

from ssmpipe.core.correspondence.coarse_to_fine import refined
from ssmpipe.core.correspondence.reparameterization import Reparameterization


def test_coarse_spaces_nest_exactly():
    for boundary, coarse_n, fine_n in (("fixed", (5, 6), (8, 10)), ("periodic", (5, 6), (10, 10))):
        coarse, fine = (Reparameterization(n, (17, 19), boundary=boundary) for n in (coarse_n, fine_n))
        b = (
            coarse.identity()[None]
            + 0.02 * np.random.default_rng(0).normal(size=(1, *coarse.identity().shape)) * coarse.free
        )
        np.testing.assert_allclose(fine.evaluate(refined(b, coarse, fine)), coarse.evaluate(b), atol=1e-12)
