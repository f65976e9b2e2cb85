from pathlib import Path

import numpy as np
import pytest

import ssmpipe
from ssmpipe.core.errors import ArtifactError, ConfigError
from ssmpipe.core.mesh.topology import boundary_loops, euler_characteristic, is_manifold
from ssmpipe.use.model import SURFACES, Model
from tests.support.models import curve_model, shape_model, write_model


@pytest.fixture
def model(tmp_path: Path) -> Model:
    return ssmpipe.load_model(write_model(shape_model(), tmp_path))


def test_instance_and_project_are_inverse(model: Model) -> None:
    coefficients = np.array([1.5, -0.5, 0.25])
    points = model.instance(coefficients)
    assert np.allclose(model.project(points), coefficients, rtol=0, atol=1e-10)
    assert np.allclose(model.instance([0.0]), model.mean)
    assert model.distance([3.0, 4.0]) == pytest.approx(5.0)


def test_a_printed_model_says_its_sizes_and_no_arrays(model: Model) -> None:
    n_points = len(model.mean)
    told = f": {model.topology}, {len(model.ids)} shapes, {n_points} points in 3-D, {len(model.variances)} modes>"
    assert repr(model) == f"<Model {model.path}{told}"


def test_the_shapes_of_the_cohort_come_back_from_their_scores(model: Model) -> None:
    for row in model.scores:
        assert np.allclose(model.project(model.instance(row)), row, atol=1e-10)


def test_samples_repeat_and_have_the_variances_of_the_model(model: Model) -> None:
    points, coefficients = model.sample(4000, seed=3)
    assert np.array_equal(points, model.sample(4000, seed=3)[0])
    assert np.allclose(coefficients.std(axis=0), 1, atol=0.05)
    along = np.einsum("sld,mld->sm", points - model.mean, model.modes)
    assert np.allclose(along.var(axis=0), model.variances, rtol=0.1)


@pytest.mark.parametrize("topology", SURFACES)
def test_surfaces_are_watertight_on_demand(topology: str, tmp_path: Path) -> None:
    model = ssmpipe.load_model(write_model(shape_model(topology), tmp_path))
    n_loops = {"disk": 1, "tube": 2, "cone": 1, "closed": 0}[topology]
    surface = model.surface(model.mean)
    assert len(boundary_loops(surface.faces)) == n_loops
    assert is_manifold(surface.faces)
    closed = model.surface(model.mean, watertight=True)
    assert boundary_loops(closed.faces) == []
    assert euler_characteristic(closed.faces) == 2
    if topology != "disk":
        a, b, c = np.moveaxis(closed.vertices[closed.faces], 1, 0)
        assert np.einsum("fd,fd->", a, np.cross(b, c)) > 0


@pytest.mark.parametrize("topology", SURFACES)
def test_quads_at_a_pole_do_not_count_as_bad(topology: str, tmp_path: Path) -> None:
    model = ssmpipe.load_model(write_model(shape_model(topology, 40, 30), tmp_path))
    rows = {"disk": 29, "tube": 29, "cone": 28, "closed": 27}[topology]
    quality = model.quad_quality(model.mean)
    assert len(quality) == rows * (39 if topology == "disk" else 40)
    assert quality.min() > 0.8


def test_what_cannot_be_loaded_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"holds no model\.npz"):
        ssmpipe.load_model(tmp_path)
    (tmp_path / "a.txt").write_text("x")
    with pytest.raises(ConfigError, match=r"a\.txt is not a model\.npz"):
        ssmpipe.load_model(tmp_path / "a.txt")
    with pytest.raises(ConfigError, match=f"there is no {tmp_path / 'nowhere'}"):
        ssmpipe.load_model(tmp_path / "nowhere")
    np.savez(tmp_path / "model.npz", mean=np.zeros(3))
    with pytest.raises(ArtifactError, match="has no array"):
        ssmpipe.load_model(tmp_path)


def test_wrong_sizes_and_curves_are_refused(model: Model, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=f"9 coefficients were given, the model has {len(model.variances)} modes"):
        model.instance(np.zeros(9))
    with pytest.raises(ConfigError, match=r"the points are \(3, 3\)"):
        model.project(np.zeros((3, 3)))
    curves = ssmpipe.load_model(write_model(curve_model(), tmp_path / "curves"))
    with pytest.raises(ConfigError, match="a model of curves"):
        curves.surface(curves.mean)
