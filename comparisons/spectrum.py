"""Times `coseg describe --full` against scipy's eigsh on identical matrices, and prints Markdown.

    python comparisons/spectrum.py --sizes 2500 10000 --k 100 300         synthetic meshes
    python comparisons/spectrum.py --mesh ant.off teddy.off --k 100 300   real ones
    python comparisons/spectrum.py --tree meshes/ --k 300 --sample 20     all of a folder, a sample against scipy

Peers are scipy.sparse.linalg.eigsh at sigma = -0.01, mode shift and invert, with SuperLU (what scipy does by
itself) and with CHOLMOD (scikit-sparse, if it is installed). Everything runs in turn in processes of its
own, in rounds whose order alternates, so that a ratio is of two runs that followed each other. Timed is the
same span for all: from stiffness and mass in memory to k pairs in memory; for coseg, with the proof of
completeness. Needs numpy and scipy, and a machine that does nothing else. On one that does other work,
--processor-time counts processor time in the place of the clock, for one thread: peers measure it over the same
span, coseg's is that of the process times the share of the span in the time by the clock.
"""

import argparse
import json
import os
import statistics
import struct
import subprocess
import sys
import tempfile
import time

import numpy as np

import meshes

SIGMA = -0.01
PEERS = ["superlu", "cholmod"]
# Eigenvalues agree to this, relative to the larger of the eigenvalue and the first above zero.
AGREE = 1e-6


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--sizes", type=int, nargs="*", default=[], help="vertices of synthetic meshes")
    parser.add_argument("--shapes", nargs="*", default=list(meshes.SHAPES), choices=meshes.SHAPES)
    parser.add_argument("--mesh", nargs="*", default=[], help="mesh files")
    parser.add_argument("--tree", help="every .off and .obj below this folder, once")
    parser.add_argument("--sample", type=int, default=20, help="meshes of --tree that scipy is run on")
    parser.add_argument("--k", type=int, nargs="*", default=[300], help="numbers of eigenpairs")
    parser.add_argument("--rounds", type=int, help="default: 3, and 1 above 100,000 vertices")
    parser.add_argument("--peers", nargs="*", default=PEERS, choices=PEERS)
    parser.add_argument("--operator", default="cotan")
    parser.add_argument("--threads", type=int, default=1, help="of coseg")
    parser.add_argument("--processor-time", action="store_true", help="for a machine that does other work")
    parser.add_argument("--coseg", default="target/release/coseg")
    parser.add_argument("--python", default=sys.executable, help="interpreter of the peers")
    parser.add_argument("--keep", help="folder for meshes, matrices and raw results; default: temporary")
    parser.add_argument("--worker", nargs=5, help=argparse.SUPPRESS)
    return parser.parse_args()


# --- the peers, each in a process of its own ---------------------------------------------------------


def load(path):
    """Arrays of a safetensors file."""
    types = {"F64": "<f8", "F32": "<f4", "U32": "<u4"}
    with open(path, "rb") as f:
        (n,) = struct.unpack("<Q", f.read(8))
        header = json.loads(f.read(n))
        data = f.read()
    arrays = {}
    for name, about in header.items():
        if name != "__metadata__":
            begin, end = about["data_offsets"]
            array = np.frombuffer(data[begin:end], types[about["dtype"]])
            arrays[name] = array.reshape(about["shape"])
    return arrays


def matrices(path):
    import scipy.sparse as sp

    arrays = load(path)
    stiffness = sp.csr_matrix(
        (arrays["stiffness_data"], arrays["stiffness_indices"], arrays["stiffness_indptr"])
    ).tocsc()
    return stiffness, arrays["mass"]


def worker(peer, path, k, out, clock):
    import scipy.sparse as sp
    from scipy.sparse.linalg import LinearOperator, eigsh, splu

    clock = time.process_time if clock == "processor" else time.perf_counter
    stiffness, mass = matrices(path)
    diagonal = sp.diags(mass).tocsc()
    if peer == "superlu":
        begin = clock()
        values, vectors = eigsh(stiffness, k, diagonal, sigma=SIGMA)
        seconds = clock() - begin
    elif peer == "cholmod":
        from sksparse.cholmod import cholesky

        begin = clock()
        solve = cholesky(stiffness - SIGMA * diagonal)
        inverse = LinearOperator(stiffness.shape, matvec=solve, dtype=float)
        values, vectors = eigsh(stiffness, k, diagonal, sigma=SIGMA, OPinv=inverse)
        seconds = clock() - begin
    else:
        # Only what the floor needs: the entries of a Cholesky factor in a good order.
        factor = splu(
            stiffness - SIGMA * diagonal,
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
        json.dump({"factor": factor.L.nnz}, open(out, "w"))
        return
    order = np.argsort(values)
    values, vectors = values[order], vectors[:, order]
    residual = stiffness @ vectors - mass[:, None] * vectors * values
    norms = np.sqrt((residual**2 / mass[:, None]).sum(0))
    positive = values[values > 1e-6 * values[-1]]
    scale = np.maximum(values, positive[0] if len(positive) else 1)
    result = {
        "ms": 1e3 * seconds,
        "residual": (norms / scale).max(),
        "eigenvalues": values.tolist(),
    }
    json.dump(result, open(out, "w"))


# --- running ----------------------------------------------------------------------------------------


def run(command):
    """Standard output, peak memory (MB) and processor time (ms) of a process of its own."""
    environment = dict(os.environ, OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    for name in ["OPENBLAS_CORETYPE", "OPENBLAS_L2_SIZE"]:
        environment.pop(name, None)
    process = subprocess.Popen(command, stdout=subprocess.PIPE, env=environment)
    text = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    if process.returncode != 0:
        raise RuntimeError(f"{' '.join(command)} exited with {process.returncode}")
    return text, usage.ru_maxrss / 1024, 1e3 * (usage.ru_utime + usage.ru_stime)


class Bench:
    def __init__(self, options, folder):
        self.options = options
        self.folder = folder
        self.peers = [peer for peer in options.peers if self.has(peer)]
        self.raw = []

    def has(self, peer):
        if peer != "cholmod":
            return True
        found = subprocess.run([self.options.python, "-c", "import sksparse.cholmod"], capture_output=True)
        if found.returncode != 0:
            print("scikit-sparse is not installed: no CHOLMOD", file=sys.stderr)
        return found.returncode == 0

    def coseg(self, path, k, extra=()):
        o = self.options
        command = [o.coseg, "describe", path, "--full", "--k", str(k), "--operator", o.operator]
        text, memory, processor = run([*command, "--threads", str(o.threads), "--timings", "--json", *extra])
        found = json.loads(text)
        timings = found["timings_ms"]
        if o.processor_time:
            share = processor / sum(ms for n, ms in timings.items() if "." not in n)
            timings = {n: ms * share for n, ms in timings.items()}
        parts = {n.removeprefix("spectrum."): ms for n, ms in timings.items() if "spectrum." in n}
        return {
            "ms": timings["spectrum"],
            "memory": memory,
            "residual": found["max_relative_residual"],
            "eigenvalues": found["eigenvalues"],
            "certificate": found["certificate"],
            "parts": parts,
            "n": found["n_vertices"],
        }

    def peer(self, name, matrix, k):
        out = os.path.join(self.folder, "out.json")
        clock = "processor" if self.options.processor_time else "wall"
        command = [self.options.python, os.path.abspath(__file__), "--worker", name, matrix, str(k), out, clock]
        _, memory, _ = run(command)
        with open(out) as f:
            return dict(json.load(f), memory=memory)

    def matrix(self, path):
        """The matrices that coseg makes of a mesh, in a file."""
        out = os.path.join(self.folder, "matrix.safetensors")
        self.coseg(path, 4, ["-o", out])
        return out

    def row(self, name, path, k, n_rounds):
        matrix = self.matrix(path)
        runs = {who: [] for who in [*self.peers, "coseg"]}
        for i in range(n_rounds):
            for who in list(runs) if i % 2 == 0 else reversed(list(runs)):
                one = self.coseg(path, k) if who == "coseg" else self.peer(who, matrix, k)
                runs[who].append(one)
                self.raw.append({"mesh": name, "k": k, "round": i, "who": who, **one})
                print(f"{name} k={k} {who}: {one['ms']:.0f} ms", file=sys.stderr)
        factor = self.peer("factor", matrix, k)["factor"]
        return {"name": name, "k": k, "runs": runs, "factor": factor}


def synthetic(shape, size, folder):
    path = os.path.join(folder, f"{shape}-{size}.off")
    if not os.path.exists(path):
        meshes.write_off(path, *meshes.SHAPES[shape](size))
    return path


def peak():
    """Multiplications and additions a second of one thread, in double precision, times 2."""
    code = (
        "import numpy as np, time\n"
        "a = np.random.default_rng(0).normal(size=(1500, 1500))\n"
        "def once():\n"
        "    t = time.process_time(); a @ a; return time.process_time() - t\n"
        "print(2 * 1500**3 / min(once() for _ in range(7)))"
    )
    return float(run([sys.executable, "-c", code])[0])


# --- tables -----------------------------------------------------------------------------------------


def disagreement(mine, theirs):
    """Largest difference of eigenvalues, relative as AGREE is."""
    mine, theirs = np.array(mine), np.array(theirs)
    positive = mine[mine > 1e-6 * mine[-1]]
    scale = np.maximum(np.abs(mine), positive[0] if len(positive) else 1)
    return (np.abs(mine - theirs) / scale).max()


def median(runs, key):
    return statistics.median(one[key] for one in runs)


def ratios(theirs, mine):
    each = [a["ms"] / b["ms"] for a, b in zip(theirs, mine)]
    text = f"{statistics.median(each):.1f}"
    return text if len(each) == 1 else f"{text} ({min(each):.1f}–{max(each):.1f})"


def table(header, rows):
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join("| " + " | ".join(line) + " |" for line in lines) + "\n"


def report(rows, peers, flops):
    comparison, quality, stages = [], [], []
    names = []
    for row in rows:
        for one in row["runs"]["coseg"]:
            names += [n for n in one["parts"] if n not in names]
    for row in rows:
        k, mine = row["k"], row["runs"]["coseg"]
        n, label = mine[0]["n"], f"{row['name']} ({mine[0]['n']:,})"
        times = [f"{median(row['runs'][who], 'ms'):,.0f}" for who in [*peers, "coseg"]]
        memory = [f"{median(row['runs'][who], 'memory'):.0f}" for who in [*peers, "coseg"]]
        over = [ratios(row["runs"][who], mine) for who in peers]
        comparison.append([label, str(k), *times, *over, *memory])
        certificate = mine[0]["certificate"]
        agreement = []
        for who in peers:
            worst = max(disagreement(mine[0]["eigenvalues"], one["eigenvalues"]) for one in row["runs"][who])
            agreement.append(f"{worst:.0e}" + ("" if worst <= AGREE else " **differs**"))
        residuals = [f"{max(one['residual'] for one in row['runs'][who]):.0e}" for who in [*peers, "coseg"]]
        proof = [f"{certificate['tau']:.4f}", str(certificate["count"]), f"{certificate['margin']:.1e}"]
        quality.append([label, str(k), *residuals, *agreement, *proof])
        floor = [2 * n * k**2, n * k**2, 4 * row["factor"] * k]
        parts = [statistics.median(one["parts"].get(name, 0.0) for one in mine) for name in names]
        stages.append(
            [label, str(k), times[-1], *(f"{ms:.0f}" for ms in parts)]
            + [f"{1e3 * sum(floor) / flops:.0f}", f"{1e3 * floor[2] / flops:.0f}"]
        )
    whose = [*peers, "coseg"]
    print(f"Peak of one thread (dgemm): {flops / 1e9:.1f} GFlop/s.\n")
    header = ["mesh (vertices)", "k"]
    over = [f"{who} ÷ coseg" for who in peers]
    print(table([*header, *(f"{w}, ms" for w in whose), *over, *(f"{w}, MB" for w in whose)], comparison))
    agree = [f"λ against {who}" for who in peers]
    residual = [f"{w}, residual" for w in whose]
    print(table([*header, *residual, *agree, "τ", "count", "margin"], quality))
    floor = ["floor", "of it solves"]
    print(table([*header, "total, ms", *names, *floor], stages))


def tree(bench, options):
    paths = []
    for folder, _, files in os.walk(options.tree):
        paths += [os.path.join(folder, f) for f in files if f.endswith((".off", ".obj"))]
    paths.sort()
    if not paths:
        raise SystemExit(f"{options.tree}: no .off or .obj file")
    sample = {paths[i * len(paths) // options.sample] for i in range(min(options.sample, len(paths)))}
    for k in options.k:
        mine, failed, over = [], [], {who: [] for who in bench.peers}
        for path in paths:
            try:
                one = bench.coseg(path, k)
            except RuntimeError as error:
                failed.append(str(error))
                continue
            one["proved"] = one["certificate"]["count"] >= k and one["certificate"]["proved"]
            mine.append(one)
            bench.raw.append({"mesh": path, "k": k, "who": "coseg", **one})
            for who in bench.peers if path in sample else []:
                theirs = bench.peer(who, bench.matrix(path), k)
                worst = disagreement(one["eigenvalues"], theirs["eigenvalues"])
                over[who].append((theirs["ms"] / one["ms"], worst))
                bench.raw.append({"mesh": path, "k": k, "who": who, **theirs})
                print(f"{path}: {who} {theirs['ms']:.0f} ms, {one['ms']:.0f} ms", file=sys.stderr)
        print(f"### {len(paths)} meshes of {os.path.basename(options.tree.rstrip('/'))}, k = {k}\n")
        print(f"- {len(mine)} spectra, {len(failed)} refused" + "".join(f"\n  - {f}" for f in failed))
        if not mine:
            continue
        ms = [one["ms"] for one in mine]
        print(f"- total {sum(ms) / 1e3:.1f} s, median {statistics.median(ms):.0f} ms, slowest {max(ms):.0f} ms")
        print(f"- worst residual {max(one['residual'] for one in mine):.1e}")
        print(f"- proved complete: {sum(one['proved'] for one in mine)} of {len(mine)}")
        for who, found in over.items():
            if found:
                each = [ratio for ratio, _ in found]
                spread = f"{min(each):.1f}–{max(each):.1f}"
                worst = max(worst for _, worst in found)
                print(
                    f"- {who} ÷ coseg on a sample of {len(found)}: "
                    f"median {statistics.median(each):.1f} ({spread}); eigenvalues agree to {worst:.0e}"
                )
        print()


def main():
    options = arguments()
    if options.worker:
        peer, path, k, out, clock = options.worker
        return worker(peer, path, int(k), out, clock)
    with tempfile.TemporaryDirectory() as temporary:
        folder = options.keep or temporary
        os.makedirs(folder, exist_ok=True)
        bench = Bench(options, folder)
        if options.tree:
            tree(bench, options)
        inputs = [(os.path.splitext(os.path.basename(path))[0], path) for path in options.mesh]
        for size in options.sizes:
            inputs += [(shape, synthetic(shape, size, folder)) for shape in options.shapes]
        rows = []
        for name, path in inputs:
            n = bench.coseg(path, 4)["n"]
            n_rounds = options.rounds or (3 if n <= 100_000 else 1)
            rows += [bench.row(name, path, k, n_rounds) for k in options.k]
        if rows:
            report(rows, bench.peers, peak())
        if options.keep:
            with open(os.path.join(folder, "raw.json"), "w") as f:
                json.dump(bench.raw, f, indent=1)


if __name__ == "__main__":
    main()
