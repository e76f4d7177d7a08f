"""Times a map between points against pyFM's fit and ZoomOut in one run, in turn, and prints Markdown.

    python comparisons/maps.py --meshes DIR [--rounds 3]

DIR has pyFM's example: cat-00.off, lion-00.off, and lion2cat, which has for each vertex of the lion one of the cat. pyFM is
pyfmaps 1.3.1 from the Python package index. Both get spectra for nothing, and both use one thread. Of pyFM two spans are
printed: descriptors, fit and ZoomOut from 30 to 100 in steps of 5; and without descriptors. Of coseg, `coseg-bench maps`
times from samples and probe functions to the dense map of size 100 with its quality; what is computed once a shape for
all its maps is printed beside it. Errors are mean distances on the cat, divided by the square root of its area: by edges
for both.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import time

for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "RAYON_NUM_THREADS"):
    os.environ[name] = "1"

import numpy as np  # noqa: E402  (threads must be set before)

WEIGHTS = {
    "pyFM, weights of its README": dict(w_descr=1e0, w_lap=1e-1, w_dcomm=1e0, w_orient=1e0),
    "pyFM, defaults": {},
}
K_FIT, K_END, STEP = 30, 100, 5


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--meshes", required=True, help="folder with cat-00.off, lion-00.off and lion2cat")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--bench", default="target/release/coseg-bench")
    return parser.parse_args()


def pyfm(meshes):
    """What runs pyFM once and gives the seconds of its stages and its map."""
    from pyFM.functional import FunctionalMapping
    from pyFM.mesh import TriMesh

    load = lambda name: TriMesh.load(f"{meshes}/{name}.off", area_normalize=True, center=True)
    cat, lion = load("cat-00"), load("lion-00")
    cat.process(k=K_END)
    lion.process(k=K_END)

    def run(weights):
        begin = time.perf_counter()
        model = FunctionalMapping(cat, lion)
        model.preprocess(descr_type="WKS", subsample_step=2, k_process=K_END)
        described = time.perf_counter()
        model.fit(K=K_FIT, **weights)
        refined = model.zoomout_refine(nit=(K_END - K_FIT) // STEP, step=STEP)
        p2p = model.get_p2p(refined)
        end = time.perf_counter()
        return end - begin, end - described, p2p

    truth = np.loadtxt(f"{meshes}/lion2cat", dtype=int)
    distances = cat.geodesic_matrix(method="dijkstra")
    error = lambda p2p: distances[truth, p2p].mean() / np.sqrt(cat.area)
    return run, error


def ours(args):
    """Milliseconds and error of one map."""
    files = [f"{args.meshes}/{name}" for name in ("cat-00.off", "lion-00.off", "lion2cat")]
    command = [args.bench, "maps", "--json", "--pair", *files]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)}: {done.stderr}")
    (found,) = json.loads(done.stdout)["sets"]
    return found


def main():
    args = arguments()
    run, error = pyfm(args.meshes)
    times = {name: [] for name in WEIGHTS}
    errors, own = {}, []
    for _ in range(args.rounds):
        own.append(ours(args))
        for name, weights in WEIGHTS.items():
            *seconds, p2p = run(weights)
            times[name].append(seconds)
            errors[name] = error(p2p)
    median = statistics.median
    mine = median(o["estimate_ms"] for o in own) / 1e3
    print("| | with descriptors | without | error | times ours |\n| --- | --- | --- | --- | --- |")
    once = median(o["frame_ms"] for o in own) / 1e3
    print(f"| coseg | {mine + 2 * once:.3f} s | {mine:.3f} s | {own[0]['counted']:.3f} | |")
    for name, rounds in times.items():
        whole, part = (median(r[i] for r in rounds) for i in (0, 1))
        print(f"| {name} | {whole:.2f} s | {part:.2f} s | {errors[name]:.3f} | {part / mine:.0f} |")


if __name__ == "__main__":
    main()
