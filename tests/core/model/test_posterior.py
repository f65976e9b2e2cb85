import numpy as np
import pytest

from ssmpipe.core.align.rigid import rotation_vector_matrix
from ssmpipe.core.model.posterior import NOWHERE, Observations, posterior
from ssmpipe.core.model.remainder import Remainder
from ssmpipe.core.model.shape_model import ShapeModel
from tests.support.models import shape_model

MODEL = shape_model("tube", 14, 11, 9)
SIZE = float(np.sqrt(((MODEL.mean - MODEL.mean.mean(axis=0)) ** 2).sum(axis=1).mean()))
SMOOTH = Remainder(0.04, 0.3 * SIZE, 0.01)


def draw(rng: np.random.Generator, model: ShapeModel = MODEL, remainder: Remainder = SMOOTH):
    scores = rng.normal(size=len(model.variances))
    factor = np.linalg.cholesky(remainder.kernel(model.mean, model.mean) + 1e-9 * np.eye(len(model.mean)))
    smooth = factor @ rng.normal(size=model.mean.shape)
    return scores, model.instance(scores) + smooth + np.sqrt(remainder.noise) * rng.normal(size=model.mean.shape)


def test_a_whole_shape_of_the_model_gives_its_scores():
    scores = np.random.default_rng(0).normal(size=len(MODEL.variances))
    every = np.arange(len(MODEL.mean))
    sure = Remainder(1e-6, 0.3 * SIZE, 1e-6)
    found = posterior(MODEL, sure, Observations.of_places(every, MODEL.instance(scores)))
    np.testing.assert_allclose(found.scores, scores, atol=0.01)
    np.testing.assert_allclose(found.points, MODEL.instance(scores), atol=0.01)


def test_nothing_seen_but_one_far_place_leaves_the_prior():
    seen = Observations.of_places(np.array([0]), MODEL.mean[[0]])
    found = posterior(MODEL, SMOOTH, seen)
    prior = np.sqrt((MODEL.variances[:, None, None] * MODEL.modes**2).sum(axis=0) + SMOOTH.variance + SMOOTH.noise)
    far = ((MODEL.mean - MODEL.mean[0]) ** 2).sum(axis=1).argmax()
    assert (found.deviation <= prior + 1e-9).all()
    assert found.deviation[0].max() < 0.2
    assert found.deviation[far].mean() > 0.5 * prior[far].mean()


def test_the_uncertainty_of_what_is_missing_is_calibrated():
    rng = np.random.default_rng(1)
    seen = np.flatnonzero(MODEL.mean[:, 2] < 0)[:60] if (MODEL.mean[:, 2] < 0).any() else np.arange(60)
    missing = np.setdiff1d(np.arange(len(MODEL.mean)), seen)
    places, scores, ratio = [], [], []
    for _ in range(60):
        truth, points = draw(rng)
        found = posterior(MODEL, SMOOTH, Observations.of_places(seen, points[seen]))
        places.append(np.abs(found.points - points)[missing] / found.deviation[missing])
        scores.append(np.abs(found.scores - truth) / np.sqrt(np.diagonal(found.covariance)))
        ratio.append(
            np.sqrt(((found.points - points)[missing] ** 2).mean() / ((MODEL.mean - points)[missing] ** 2).mean())
        )
    assert np.mean(np.array(places) < 2) == pytest.approx(0.954, abs=0.02)
    assert np.mean(np.array(scores) < 2) == pytest.approx(0.954, abs=0.03)
    assert np.mean(ratio) < 0.7


def test_distances_along_normals_suffice():
    rng = np.random.default_rng(2)
    _, points = draw(rng)
    every = np.arange(len(points))
    directions = rng.normal(size=points.shape)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    seen = Observations(every, directions, (directions * points).sum(axis=1))
    found = posterior(MODEL, SMOOTH, seen)
    along = ((found.points - points) * directions).sum(axis=1)
    assert np.sqrt((along**2).mean()) < 0.2
    assert np.abs(found.points - points).mean() < 0.5 * np.abs(MODEL.mean - points).mean()


def test_a_small_motion_is_told_from_the_shape():
    rng = np.random.default_rng(3)
    scores = 0.2 * rng.normal(
        size=len(MODEL.variances)
    )  # motions are linear about the mean: far from it they mix with the shape
    vector, shift = np.array([0.01, -0.02, 0.015]), np.array([0.4, -0.3, 0.2])
    centre = MODEL.mean.mean(axis=0)
    points = (MODEL.instance(scores) - centre) @ rotation_vector_matrix(vector).T + centre + shift
    sure = Remainder(1e-4, 0.3 * SIZE, 1e-4)
    seen = Observations.of_places(np.arange(len(points)), points)
    found = posterior(MODEL, sure, seen, motion_deviation=(0.2, 20.0), deviation_at=NOWHERE)
    np.testing.assert_allclose(found.motion, [*vector, *shift], atol=0.02)
    assert len(found.deviation) == 0
