"""Functional maps: a shape and itself renumbered have a known map, and sums are checked in numpy."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from shapes import icosphere, lumpy, renumbered

import coseg
from coseg import geometry as g


@pytest.fixture(scope="module")
def pair() -> tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]:
    """A lumpy sphere, the same renumbered, turned and three times as large, and who is who."""
    vertices, faces = lumpy(3)
    again, others, old = renumbered(vertices, faces)
    turned = 3 * again[:, [2, 0, 1]]
    one, two = coseg.Mesh(vertices, faces), coseg.Mesh(turned, others)
    return one.spectrum(120), two.spectrum(120), old


@pytest.fixture(scope="module")
def found(pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]) -> g.FunctionalMap:
    return coseg.functional_map(pair[0], pair[1])


def apart(f: g.FunctionalMap, p2p: NDArray[np.uint32], truth: NDArray[np.int64]) -> float:
    """Mean distance on shape 1 between where vertices go and where they belong."""
    points = f.mesh_1.vertices / np.sqrt(f.mesh_1.area)
    return float(np.linalg.norm(points[p2p] - points[truth], axis=1).mean())


def test_a_renumbered_shape_is_found(
    found: g.FunctionalMap, pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]
) -> None:
    old = pair[2]
    assert found.c_12.shape == (100, 100) and found.p2p_21.shape == (642,)
    assert apart(found, found.p2p_21, old) < 0.005
    assert (old[found.p2p_12] == np.arange(642)).mean() > 0.9
    assert found.matched_2.all() and found.matched_1.all()
    assert found.quality.orientation > 0.9 and found.quality.coverage > 0.9
    assert found.quality.expected_error < 0.1
    assert found.alternative is not None and found.alternative.quality.orientation < 0
    assert "expected error" in repr(found)


def test_c_12_carries_functions_between_shapes_of_other_sizes(
    found: g.FunctionalMap, pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]
) -> None:
    one, two, old = pair
    smooth = one.eigenvectors[:, 1:6]
    by_hand = two.eigenvectors[:, :100] @ (
        found.c_12 @ (one.eigenvectors[:, :100].T @ (one.mass[:, None] * smooth))
    )
    assert np.allclose(found.transfer(smooth, method="spectral"), by_hand)
    # Values stay what they are, although shape 2 has nine times the area.
    scale = np.abs(smooth).max()
    assert np.abs(by_hand - smooth[old]).mean() < 0.01 * scale
    back = found.transfer(smooth[old], direction="2->1", method="spectral")
    assert np.abs(back - smooth).mean() < 0.03 * scale


def test_values_at_vertices(found: g.FunctionalMap) -> None:
    x = found.mesh_1.vertices[:, 0]
    assert np.array_equal(found.transfer(x), x[found.p2p_21])
    assert found.transfer(np.arange(642)).dtype == np.arange(1).dtype
    assert found.transfer(found.mesh_1.vertices.astype(np.float32)).dtype == np.float32
    names = np.array([f"v{i}" for i in range(642)])
    assert found.transfer(names)[5] == f"v{found.p2p_21[5]}"
    y = found.mesh_2.vertices[:, 0]
    assert np.array_equal(found.transfer(y, direction="2->1"), y[found.p2p_12])


def test_values_at_faces(found: g.FunctionalMap) -> None:
    one, two = found.mesh_1, found.mesh_2
    height = one.vertices[one.faces].mean(axis=1)[:, 2]
    labels = np.where(height > 0.3, 7, -3)
    carried = found.transfer(labels)
    # Shape 2 lies on its side: its second axis is the third of shape 1, three times as long.
    own = two.vertices[two.faces].mean(axis=1)[:, 0] / 3
    assert carried.dtype == labels.dtype and set(carried) == {7, -3}
    assert (carried == np.where(own > 0.3, 7, -3)).mean() > 0.97
    assert np.abs(found.transfer(height) - own).mean() < 0.05
    both = found.transfer(np.stack([height, -height], axis=1))
    assert both.shape == (two.n_faces, 2) and np.allclose(both[:, 0], -both[:, 1])
    assert (found.transfer(carried, direction="2->1") == labels).mean() > 0.95
    assert found.transfer(labels == 7).dtype == np.int64


def test_wrong_lengths_are_refused(found: g.FunctionalMap) -> None:
    with pytest.raises(coseg.GeometryError, match="shape 1 has 642 vertices and 1280 faces"):
        found.transfer(np.zeros(641))
    with pytest.raises(coseg.GeometryError, match="shape 2 has"):
        found.transfer(np.zeros(5), direction="2->1")
    with pytest.raises(coseg.GeometryError, match="shape 1 has 642"):
        found.transfer(np.zeros(642), on="faces")
    with pytest.raises(coseg.GeometryError, match="direction"):
        found.transfer(np.zeros(642), direction="12")  # type: ignore[arg-type]
    with pytest.raises(coseg.GeometryError, match="faces have no spectrum"):
        found.transfer(np.zeros(1280), method="spectral")
    # Where both numbers are equal nothing is guessed.
    vertices, faces = icosphere(0)
    few = coseg.Mesh(vertices, faces[:12])
    same = g.FunctionalMap(
        few.spectrum(3), few.spectrum(3), np.eye(3), np.arange(12, dtype=np.uint32),
        np.ones(12, bool), found.quality,
    )  # fmt: skip
    with pytest.raises(coseg.GeometryError, match="say on="):
        same.transfer(np.zeros(12))
    assert same.transfer(np.zeros(12), on="vertices").shape == (12,)


def test_the_same_input_gives_the_same_map(
    found: g.FunctionalMap, pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]
) -> None:
    one, two, _ = pair
    assert one.mesh is not None and two.mesh is not None
    again = coseg.functional_map(one.mesh.spectrum(120, threads=1), two.mesh.spectrum(120))
    assert np.array_equal(again.c_12, found.c_12) and np.array_equal(again.p2p_21, found.p2p_21)


def test_meshes_and_objects_are_taken_too() -> None:
    vertices, faces = lumpy(2)
    f = coseg.functional_map((vertices, faces), coseg.Mesh(vertices, faces), alternative=False)
    assert f.alternative is None
    assert apart(f, f.p2p_21, np.arange(162)) < 0.01


def test_landmarks_and_probes_decide() -> None:
    # A symmetric shape: an ellipsoid, whose maps to itself are its reflections.
    vertices, faces = icosphere(3)
    mesh = coseg.Mesh(vertices * [1.0, 1.4, 2.2], faces)
    s = mesh.spectrum(60)
    mirror = np.array([np.argmin(((vertices - v * [1, -1, 1]) ** 2).sum(axis=1)) for v in vertices])
    marks = np.argmax(vertices @ np.array([[0, 1, 0], [0, -1, 0], [0, 0, 1], [1, 0, 0]]).T, axis=0)
    mirrored = coseg.functional_map(s, s, landmarks=np.stack([marks, mirror[marks]], axis=1))
    assert mirrored.quality.orientation < -0.8
    assert np.linalg.norm(vertices[mirrored.p2p_21] - vertices[mirror], axis=1).mean() < 0.1
    sides = (vertices, vertices * [1, -1, 1])
    assert coseg.functional_map(s, s, probes=sides, orientation="prefer").quality.orientation < -0.8
    kept = coseg.functional_map(s, s, orientation="keep", alternative=False)
    assert kept.quality.orientation > 0.8
    with pytest.raises(coseg.GeometryError, match="landmarks of shape 2 name 642"):
        coseg.functional_map(s, s, landmarks=[[0, 642]])
    with pytest.raises(coseg.GeometryError, match="probes"):
        coseg.functional_map(s, s, probes=(vertices, vertices[:, :2]))


def test_pointwise_maps_are_nearest_rows(
    pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]], found: g.FunctionalMap
) -> None:
    one, two, _ = pair
    k1, k2 = 12, 15
    c = found.c_12[:k2, :k1]
    # Both sides in the units of shape 2; distances need no more.
    targets, queries = one.eigenvectors[:, :k1] @ c.T, two.eigenvectors[:, :k2]
    ratio = one.mass.sum() / two.mass.sum()
    targets = targets * ratio
    distances = ((queries[:, None] - targets[None]) ** 2).sum(axis=2)
    ours = g.pointwise(one, two, c)
    rows = np.arange(642)
    assert np.allclose(distances[rows, ours], distances.min(axis=1), rtol=1e-3, atol=1e-6)
    back = g.pointwise(one, two, c, direction="1->2")
    assert np.allclose(distances[back, rows], distances.min(axis=0), rtol=1e-3, atol=1e-6)
    square = found.c_12
    exact, cells = (g.pointwise(one, two, square, exact=e) for e in (True, False))
    assert (exact == cells).mean() > 0.99
    with pytest.raises(coseg.GeometryError, match="square"):
        g.pointwise(one, two, c, exact=False)


def test_functional_maps_of_pointwise_maps(
    pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]],
) -> None:
    one, two, old = pair
    c = g.functional(one, two, old, 20, 30)
    by_hand = two.eigenvectors[:, :30].T @ (two.mass[:, None] * one.eigenvectors[old, :20])
    assert np.allclose(c, by_hand, atol=1e-4)
    # The same surface in another size: orthogonal but for the scale.
    square = g.functional(one, two, old, 20, 20) / 3
    assert np.allclose(square.T @ square, np.eye(20), atol=1e-3)
    with pytest.raises(coseg.GeometryError, match="p2p_21 name"):
        g.functional(two, one, old + 1, 20, 20)


def test_a_small_map_grows(pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]) -> None:
    one, two, old = pair
    small = g.functional(one, two, old, 10, 10)
    noise = np.random.default_rng(5).normal(size=(10, 10))
    disturbed = g.icp(one, two, small + 0.3 * noise, rounds=20)
    assert np.abs(disturbed - small).max() < 0.1
    for exact in (True, False):
        large = g.zoomout(one, two, small, step=10, rounds=5, exact=exact)
        assert large.shape == (60, 60)
        assert np.abs(large - g.functional(one, two, old, 60, 60)).max() < 0.05
    with pytest.raises(coseg.GeometryError, match="grows to 210"):
        g.zoomout(one, two, small, step=10, rounds=20)


def test_precise_maps_interpolate(
    found: g.FunctionalMap, pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]]
) -> None:
    precise = found.precise
    assert precise.barycentric.shape == (642, 3)
    assert np.allclose(precise.barycentric.sum(axis=1), 1.0, atol=1e-5)
    x = found.mesh_1.vertices
    assert np.allclose(precise.matrix @ x, precise.transfer(x))
    assert np.abs(precise.transfer(x[:, 0]) - x[pair[2], 0]).mean() < 0.01


def test_fitted_maps_carry_their_probes(
    pair: tuple[g.Spectrum, g.Spectrum, NDArray[np.int64]],
) -> None:
    one, two, old = pair
    probes = g.signature_probes(one)
    assert probes.shape == (642, 34)
    c = g.fit(one, two, probes, probes[old], k1=20, k2=20)
    truth = g.functional(one, two, old, 20, 20)
    assert np.abs(c - truth).max() < 0.1 * 3
    marks = np.array([0, 100, 300])
    new = np.argsort(old)
    with_marks = g.fit(
        one, two, g.landmark_probes(one, marks), g.landmark_probes(two, new[marks]),
        k1=12, k2=12, mask="resolvent", orientation_weight=0.1,
    )  # fmt: skip
    assert np.abs(with_marks - truth[:12, :12]).max() < 0.2 * 3
    with pytest.raises(coseg.GeometryError, match="34 functions"):
        g.fit(one, two, probes, probes[old][:, :3])
    with pytest.raises(coseg.SolveError, match="not determined"):
        g.fit(one, two, probes[:, :1], probes[old][:, :1], laplacian_weight=0, commutativity_weight=0)
