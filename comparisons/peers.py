"""Times the tasks of docs/from-pyfm.md, from-lapy.md and from-robust-laplacian.md in both packages, in turn,
in one run, and prints Markdown.

    python comparisons/peers.py --meshes DIR [--rounds 3] [--k 300] [--large 0] [--tasks maps spectra distances]

DIR has pyFM's example: cat-00.off, lion-00.off, and lion2cat, which has for each vertex of the lion one of the cat. The
peers are those of the Python package index: pyfmaps, lapy, robust_laplacian with scipy, potpourri3d (whose heat method
pyFM uses), pygeodesic (exact distances). All run in this process with their default threads, in turn. Seconds are
medians; "times" is the median over the rounds of the peer's seconds by those of coseg in the same round. On a machine that does other work, --processor-time counts the processor time of all threads
in the place of the clock. Errors are mean distances on the cat along edges, divided by the square root of its area. With
--large N a map between spheres of about N vertices with lumps is timed too, spectra given.
"""

import argparse
import contextlib
import io
import statistics
import time
from pathlib import Path

import numpy as np

import coseg


TASKS = ["maps", "spectra", "distances"]


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", required=True, type=Path)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--k", type=int, default=300)
    parser.add_argument("--tasks", nargs="*", default=TASKS, choices=TASKS)
    parser.add_argument("--processor-time", action="store_true", help="for a machine that does other work")
    parser.add_argument("--large", type=int, default=0, help="vertices")
    return parser.parse_args()


def pyfm(cat, lion, weights):
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    one, two = (TriMesh.load(str(path), area_normalize=True, center=True) for path in (cat, lion))
    one.process(k=110)
    two.process(k=110)
    model = FunctionalMapping(one, two)
    model.preprocess(descr_type="WKS", subsample_step=2, k_process=110)
    model.fit(K=30, **weights)
    return model.get_p2p(model.zoomout_refine(nit=16, step=5))


def ours(cat, lion):
    return coseg.functional_map(coseg.read_mesh(cat), coseg.read_mesh(lion)).p2p_21


def lapy(path, k):
    from lapy import Solver, TriaMesh

    return Solver(TriaMesh.read_off(str(path)), lump=True).eigs(k=k)[0]


def robust(path, k):
    import robust_laplacian
    from scipy.sparse.linalg import eigsh

    mesh = coseg.read_mesh(path)
    stiffness, mass = robust_laplacian.mesh_laplacian(mesh.vertices, mesh.faces.astype(np.int64))
    return np.sort(eigsh(stiffness, k, mass, sigma=-0.01)[0])


def alternate(tasks, rounds, clock):
    """Seconds of each round and the last result of each task."""
    seconds, results = {name: [] for name in tasks}, {}
    for _ in range(rounds):
        for name, task in tasks.items():
            begin = clock()
            with contextlib.redirect_stdout(io.StringIO()):
                results[name] = task()
            seconds[name].append(clock() - begin)
    return seconds, results


def table(seconds, notes, ours):
    """`ours` names for each peer the task of coseg that does the same."""
    print("\n| | seconds | times | |\n| --- | --- | --- | --- |")
    for name, own in seconds.items():
        ratio = ""
        if name in ours:
            rounds = zip(own, seconds[ours[name]], strict=True)
            ratio = f"{statistics.median(theirs / best for theirs, best in rounds):.3g}"
        print(f"| {name} | {statistics.median(own):.2f} | {ratio} | {notes[name]} |")


def maps(args):
    cat, lion = args.meshes / "cat-00.off", args.meshes / "lion-00.off"
    truth = np.loadtxt(args.meshes / "lion2cat", dtype=int)
    mesh = coseg.read_mesh(cat)
    readme = dict(w_descr=1e0, w_lap=1e-1, w_dcomm=1e0, w_orient=1e0)
    tasks = {
        "pyFM, its defaults: files to refined map": lambda: pyfm(cat, lion, {}),
        "pyFM, the weights of its README": lambda: pyfm(cat, lion, readme),
        "coseg: files to refined map": lambda: ours(cat, lion),
    }
    seconds, found = alternate(tasks, args.rounds, args.clock)
    places = np.unique(truth)
    distances = np.empty((mesh.n_vertices, mesh.n_vertices), np.float32)
    for begin in range(0, len(places), 200):
        some = places[begin : begin + 200]
        distances[some] = mesh.edge_distances(some)
    error = {n: distances[truth, p].mean() / np.sqrt(mesh.area) for n, p in found.items()}
    *peers, own = tasks
    table(seconds, {n: f"error {e:.3f}" for n, e in error.items()}, dict.fromkeys(peers, own))


def spectra(args):
    path = args.meshes / "cat-00.off"
    mesh = coseg.read_mesh(path)
    laplacian = mesh.laplacian()
    seconds, found = alternate(
        {
            f"LaPy: {args.k} eigenpairs": lambda: lapy(path, args.k),
            "coseg, `cotan`": lambda: coseg.read_mesh(path).spectrum(args.k, "cotan").eigenvalues,
            f"robust_laplacian and eigsh: {args.k} eigenpairs": lambda: robust(path, args.k),
            "coseg, `tufted`": lambda: coseg.read_mesh(path).spectrum(args.k).eigenvalues,
            "coseg, of given matrices": lambda: coseg.geometry.spectrum(
                laplacian.stiffness, laplacian.mass, args.k
            ).eigenvalues,
        },
        args.rounds,
        args.clock,
    )
    names = list(seconds)
    peer = {names[1]: names[0], names[3]: names[2], names[4]: names[2]}
    notes = {n: "" for n in names}
    for name, other in peer.items():
        apart = np.abs(found[name][1:] / found[other][1:] - 1).max()
        notes[name] = f"eigenvalues differ by at most {apart:.0e}"
    table(seconds, notes, {names[0]: names[1], names[2]: names[3]})


def distances(args):
    import potpourri3d
    from pygeodesic.geodesic import PyGeodesicAlgorithmExact

    mesh = coseg.read_mesh(args.meshes / "cat-00.off")
    sources = list(range(0, mesh.n_vertices, mesh.n_vertices // 10))[:10]

    def potpourri():
        solver = potpourri3d.MeshHeatMethodDistanceSolver(mesh.vertices, mesh.faces)
        return np.stack([solver.compute_distance(s) for s in sources])

    tasks = {
        "potpourri3d: from 10 vertices, by heat": potpourri,
        "coseg, by heat": lambda: mesh.geodesics(sources),
        "coseg, along edges": lambda: mesh.geodesics(sources, method="edges"),
    }
    seconds, found = alternate(tasks, args.rounds, args.clock)
    solver = PyGeodesicAlgorithmExact(mesh.vertices, mesh.faces.astype(np.int32))
    exact = np.stack([solver.geodesicDistances(np.array([s]), None)[0] for s in sources])
    off = {n: np.abs(d - exact).mean() / exact.mean() for n, d in found.items()}
    peer, own, _ = tasks
    table(seconds, {n: f"{o:.2%} from the exact ones" for n, o in off.items()}, {peer: own})


def large(n, clock):
    """A map between spheres with lumps."""
    side = round(np.sqrt(n / 2))

    def lumpy(stretch):
        polar, turn = np.meshgrid(np.pi * (np.arange(side) + 0.5) / side, np.pi * np.arange(2 * side) / side)
        p = np.stack([np.sin(polar) * np.cos(turn), np.sin(polar) * np.sin(turn), np.cos(polar)], axis=-1)
        p = p.transpose(1, 0, 2).reshape(-1, 3)
        grown = 1.0
        for place, height in [((0, 0, 1), 0.8), ((1, 0, 0.2), 0.5), ((-0.9, 0.3, 0), 0.4)]:
            grown = grown + height * np.exp(-6 * ((p - place) ** 2).sum(axis=1))
        p = p * np.asarray(grown)[:, None] * [1, 1, stretch]
        i, j = np.meshgrid(np.arange(side - 1), np.arange(2 * side), indexing="ij")
        at = lambda i, j: (i * 2 * side + j % (2 * side)).reshape(-1)
        a, b, c, d = at(i, j), at(i + 1, j), at(i + 1, j + 1), at(i, j + 1)
        return coseg.Mesh(p, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]))

    one, two = (lumpy(stretch) for stretch in (1.0, 1.2))
    begin = clock()
    solver = coseg.geometry.Geodesics(one)
    middle = clock()
    solver.distances(range(8))
    print(f"\n{one.n_vertices} vertices: distances prepared in {middle - begin:.2f} s, ", end="")
    print(f"from 8 sources in {clock() - middle:.2f} s")
    begin = clock()
    s, t = one.spectrum(100), two.spectrum(100)
    middle = clock()
    f = coseg.functional_map(s, t)
    end = clock()
    off = np.linalg.norm(one.vertices[f.p2p_21] - one.vertices, axis=1).mean() / np.sqrt(one.area)
    print(f"\n{one.n_vertices} vertices each: both spectra {middle - begin:.1f} s, the dense map {end - middle:.1f} s")
    print(f"mean distance to the corresponding point {off:.4f}, {f!r}")


if __name__ == "__main__":
    options = arguments()
    options.clock = time.process_time if options.processor_time else time.perf_counter
    if "maps" in options.tasks:
        maps(options)
    if "spectra" in options.tasks:
        spectra(options)
    if "distances" in options.tasks:
        distances(options)
    if options.large:
        large(options.large, options.clock)
