from __future__ import annotations

import numpy as np

from ssmpipe.core.align.frames import femur_distal_frame
from ssmpipe.core.align.rigid import apply, move, reflection
from ssmpipe.core.parameterize.cone import parameterize_poles
from ssmpipe.core.parameterize.poles import apex_of, ends_of
from ssmpipe.core.parameterize.traced import parameterize_traced
from ssmpipe.core.repair.cleaning import clean
from ssmpipe.core.repair.decimation import decimate
from ssmpipe.core.repair.trimming import trim
from tests.support.femora import femur, landmark, needs_femora

Z = np.array([0, 0, 1.0])


@needs_femora
def test_real_femora_map_without_folds_from_a_repeatable_apex():
    offsets = []
    for shape_id in ("z013_Femur_L", "z042_Femur_R"):
        bone = decimate(clean(femur(shape_id)).mesh, 8000).mesh
        matrix = reflection(0) if shape_id.endswith("L") else np.eye(4)
        matrix = femur_distal_frame(move(bone, matrix)).matrix @ matrix
        bone = move(bone, matrix)
        head = apply(matrix, landmark(shape_id, "MFH")[None])[0]
        cut = apply(matrix, landmark(shape_id, "LT")[None])[0][2] - 20.0
        cap = trim(bone, cut * Z, -Z)
        apex = apex_of(cap)
        offsets.append(apex - head)
        found = parameterize_poles(cap, apex)
        # the harmonic map gives the apex ring more than a tenth of v
        assert found.n_folds_harmonic == 0
        assert found.ring_before[0] > 0.1
        assert found.ring[0] < 0.03
        assert found.stretch[-1] < 1.15 < found.stretch[0]
        # between two traced lines, without relaxation: as good as the changes of u and v alone make it
        traced = parameterize_traced(cap, apex)
        assert traced.stretch[-1] < 1.25 < traced.stretch[0]
        assert traced.ring[0] < 0.03
        antapex, top, factor, cosine = ends_of(bone, Z)
        assert factor > 4.0
        assert cosine > 0.95
        # the same place of the head, although the whole bone decides here
        assert np.linalg.norm(top - apex) < 6.0
        assert parameterize_poles(bone, top, antapex).stretch[-1] < 1.25
    # the raters of the landmark differ by more
    assert np.linalg.norm(offsets[0] - offsets[1]) < 6.0
    assert np.linalg.norm(offsets, axis=1).max() < 25.0
