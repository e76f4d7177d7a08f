"""Spectra of meshes and matrices, against formulas and scipy."""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest
from scipy import sparse
from scipy.sparse.linalg import eigsh
from shapes import icosphere, lumpy, sphere

import coseg
from coseg.geometry import Mesh, spectrum


def test_the_sphere_has_the_eigenvalues_of_the_sphere() -> None:
    s = sphere(4).spectrum(k=25)
    exact = np.repeat([0, 2, 6, 12, 20], [1, 3, 5, 7, 9])
    assert np.allclose(s.eigenvalues, exact, rtol=0.01, atol=1e-8)
    assert s.certificate.is_proved and s.certificate.count >= 25
    gram = s.eigenvectors.T @ (s.mass[:, None] * s.eigenvectors)
    assert np.allclose(gram, np.eye(25), atol=1e-8)
    assert s.residuals.max() < 1e-7
    assert repr(s) == "Spectrum(k=25, n=2562, tufted, 0 to 19.87, proved complete)"


@pytest.mark.parametrize("operator", ["tufted", "cotan", "mesh-laplace"])
def test_the_pairs_are_those_of_scipy(operator: str) -> None:
    mesh = Mesh(*lumpy(3))
    laplacian = mesh.laplacian(operator)
    w, a = laplacian.stiffness, laplacian.mass_matrix
    assert abs(w.sum(axis=1)).max() < 1e-9 and abs(w - w.T).max() < 1e-12
    assert a.diagonal().sum() == pytest.approx(mesh.area, rel=1e-3)
    theirs = np.sort(eigsh(w, 30, a.tocsc(), sigma=-0.01, return_eigenvectors=False))
    ours = mesh.spectrum(30, operator)
    assert np.allclose(ours.eigenvalues, theirs, rtol=1e-7, atol=1e-7)
    # The same of the matrices alone, whatever their format.
    for given, mass in [(w.tocoo(), a), (w.tocsc(), a.diagonal())]:
        found = spectrum(given, mass, 30)
        assert np.array_equal(found.eigenvalues, ours.eigenvalues)
        assert np.array_equal(found.eigenvectors, ours.eigenvectors)


def test_units_are_those_of_the_mesh() -> None:
    vertices, faces = lumpy(2)
    one, large = Mesh(vertices, faces).spectrum(20), Mesh(10 * vertices, faces).spectrum(20)
    assert np.allclose(large.eigenvalues[1:] * 100, one.eigenvalues[1:], rtol=1e-8)
    assert large.mass.sum() == pytest.approx(100 * one.mass.sum())
    assert np.allclose(large.shape_dna(10), one.shape_dna(10))


def test_the_result_depends_on_no_threads() -> None:
    mesh = sphere(4)
    one, more = mesh.spectrum(100, threads=1), mesh.spectrum(100, threads=3)
    assert np.array_equal(one.eigenvectors, more.eigenvectors)
    assert np.array_equal(one.eigenvalues, mesh.spectrum(100).eigenvalues)


def test_components_have_a_zero_each_unless_bridges_join_them() -> None:
    vertices, faces = icosphere(2)
    apart = Mesh(np.concatenate([vertices, vertices + 3]), np.concatenate([faces, faces + 162]))
    free, joined = apart.spectrum(8), apart.spectrum(8, bridges=True)
    assert (free.n_zero, joined.n_zero) == (2, 1)
    assert joined.n_bridges >= 1 and 0 < joined.eigenvalues[1] < 0.5
    with pytest.raises(coseg.GeometryError, match="bridges=True"):
        coseg.functional_map(free, joined)


def test_signatures_are_their_sums() -> None:
    s = Mesh(*lumpy(3)).spectrum(60)
    values, squares = s.eigenvalues, s.eigenvectors**2
    h = s.hks()
    assert h.shape == (s.n_vertices, 100)
    low, high = 4 * np.log(10) / values[-1], 4 * np.log(10) / values[1]
    times = np.geomspace(low, high, 100)
    assert np.allclose(h, squares @ np.exp(-np.outer(values, times)), rtol=1e-6)
    assert np.allclose(s.hks([0.1, 2.0]), squares @ np.exp(-np.outer(values, [0.1, 2.0])))
    w = s.wks(30)
    # Their mean over the surface is 1 over the area.
    assert np.allclose(s.mass @ w, 1.0, atol=1e-9)
    energies = np.linspace(np.log(values[1]), np.log(values[-1]), 30)
    sigma = 0.07 * (energies[-1] - energies[0])
    bands = np.exp(-((energies[None] - np.log(values[1:, None])) ** 2) / (2 * sigma**2))
    assert np.allclose(w, squares[:, 1:] @ (bands / bands.sum(axis=0)), rtol=1e-6)
    assert np.allclose(s.gps(5), s.eigenvectors[:, 1:6] / np.sqrt(values[1:6]))
    with pytest.raises(coseg.GeometryError, match="59"):
        s.gps(60)


def test_projection_and_synthesis() -> None:
    s = sphere(3).spectrum(16)
    assert s.mesh is not None
    height = s.mesh.vertices[:, 2]
    assert np.allclose(s.synthesize(s.project(height)), height, atol=2e-3)
    both = s.project(np.stack([height, height**2], axis=1), k=4)
    assert both.shape == (4, 2)
    with pytest.raises(coseg.GeometryError, match="642 vertices"):
        s.project(height[:-1])


def test_refusals() -> None:
    mesh = sphere(1)
    with pytest.raises(coseg.SpectrumError, match="43 eigenpairs were requested") as raised:
        mesh.spectrum(43)
    assert raised.value.kind == "Count"
    with pytest.raises(coseg.GeometryError, match="operator"):
        mesh.spectrum(5, "magic")
    with pytest.raises(coseg.SpectrumError, match="tolerance"):
        mesh.spectrum(5, tolerance=1.0)
    laplacian = mesh.laplacian()
    with pytest.raises(coseg.GeometryError, match="41"):
        spectrum(laplacian.stiffness, laplacian.mass[:-1], 5)
    with pytest.raises(coseg.SpectrumError, match=r"\(0, 5\)|\(5, 0\)") as lopsided:
        broken = laplacian.stiffness.tolil()
        broken[0, 5] = 7.0
        spectrum(broken, laplacian.mass, 5)
    assert lopsided.value.kind == "NotSymmetric"
    with pytest.raises(coseg.GeometryError, match="off its diagonal"):
        spectrum(laplacian.stiffness, sparse.csr_matrix(np.ones((42, 42))), 5)


def test_progress_is_reported_and_may_stop_the_work() -> None:
    mesh = sphere(6)
    stages = []
    mesh.spectrum(60, progress=lambda stage, done, expected: stages.append((stage, done, expected)))
    assert stages and all(done <= expected for _, done, expected in stages)

    class Enough(Exception):
        pass

    def stop(stage: str, done: int, expected: int) -> None:
        raise Enough

    begin = time.monotonic()
    with pytest.raises(Enough):
        mesh.spectrum(300, progress=stop)
    assert time.monotonic() - begin < 5


def test_ctrl_c_works_and_other_threads_run() -> None:
    mesh = sphere(6)
    ticks = 0

    def interrupt() -> None:
        nonlocal ticks
        for _ in range(20):
            time.sleep(0.01)
            ticks += 1
        os.kill(os.getpid(), signal.SIGINT)

    thread = threading.Thread(target=interrupt)
    begin = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        thread.start()
        for _ in range(100):
            mesh.spectrum(500, tolerance=1e-12)
    thread.join()
    assert ticks == 20
    assert time.monotonic() - begin < 10


def test_a_forked_process_computes_too() -> None:
    mesh = sphere(3)
    expected = mesh.spectrum(50).eigenvalues
    child = os.fork()
    if child == 0:
        same = np.array_equal(mesh.spectrum(50).eigenvalues, expected)
        os._exit(0 if same else 1)
    assert os.waitpid(child, 0)[1] == 0
