"""A real Prometheus scrapes a real daemon, and answers what the dashboard and the alerts of docs/metrics.md ask.

    python3 tests/metrics/run.py COSEG

Prometheus is Debian's, unpacked into a temporary folder and not installed. Grafana itself is in no package registry; the
dashboard is read by the models that Grafana generates from its own schema (`grafana-foundation-sdk`), if pip has them.
"""

from __future__ import annotations

import html
import json
import os
import re
import socket
import subprocess
import sys
import tempfile
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
DASHBOARD = ROOT / "config/grafana/dashboard.json"
#: What a healthy daemon that is idle does not have: an answer without data is right.
MAY_BE_EMPTY = ("coseg_requests_refused_total", "coseg_background_errors_total", "coseg_shapes_at_stage")


def free_port() -> int:
    with socket.socket() as s:
        s.bind(("127.0.0.1", 0))
        port: int = s.getsockname()[1]
        return port


def get(url: str) -> str:
    with urllib.request.urlopen(url, timeout=10) as answer:
        text: str = answer.read().decode()
        return text


def wait_for(what: str, holds: object, seconds: float = 60) -> None:
    assert callable(holds)
    end = time.monotonic() + seconds
    while True:
        try:
            if holds():
                return
        except OSError:
            pass
        if time.monotonic() > end:
            raise SystemExit(f"{what}: not within {seconds} s")
        time.sleep(0.2)


def alerts() -> list[str]:
    """The conditions of docs/metrics.md."""
    text = (ROOT / "docs/metrics.md").read_text().split("## Worth an alert")[1]
    rows = re.findall(r"^\| `(.*?)`(?: for .*?| .*?)? \|", text, re.MULTILINE)
    return [row.replace("\\|", "|") for row in rows]


def model(work: Path) -> str:
    """What Grafana's own models say of the dashboard."""
    subprocess.run([sys.executable, "-m", "venv", str(work / "venv")], check=True)
    pip = [str(work / "venv/bin/pip"), "install", "-q", "grafana-foundation-sdk"]
    if subprocess.run(pip, capture_output=True, check=False).returncode != 0:
        return "grafana-foundation-sdk could not be had: the dashboard was not read by Grafana's models"
    code = """
import json, sys
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.cog.plugins import register_default_plugins
from grafana_foundation_sdk.models.dashboard import Dashboard
register_default_plugins()
raw = json.load(open(sys.argv[1]))
again = json.loads(JSONEncoder().encode(Dashboard.from_json(raw)))
def lost(a, b, at=""):
    if isinstance(a, dict):
        for k, v in a.items():
            if not isinstance(b, dict) or k not in b:
                yield f"{at}.{k}"
            else:
                yield from lost(v, b[k], f"{at}.{k}")
    elif isinstance(a, list):
        if not isinstance(b, list) or len(a) != len(b):
            yield at
        else:
            for i, (x, y) in enumerate(zip(a, b)):
                yield from lost(x, y, f"{at}[{i}]")
    elif a != b and not (isinstance(a, (int, float)) and float(a) == float(b)):
        yield f"{at}: {a} is {b}"
unknown = list(lost(raw, again))
assert not unknown, unknown
print(len(again["panels"]), "panels, every field known to Grafana's schema")
"""
    done = subprocess.run([str(work / "venv/bin/python"), "-c", code, str(DASHBOARD)], capture_output=True, text=True, check=False)
    if done.returncode != 0:
        raise SystemExit(done.stderr)
    return done.stdout.strip()


def main() -> int:
    coseg = str(Path(sys.argv[1]).resolve())
    faults = []
    with tempfile.TemporaryDirectory(prefix="metrics") as folder:
        work = Path(folder)
        # Unpacked as a user who need not be root may.
        subprocess.run(["apt-get", "download", "-qq", "prometheus"], cwd=work, check=True, capture_output=True)
        subprocess.run(["dpkg", "-x", *[str(p) for p in work.glob("prometheus_*.deb")], str(work / "root")], check=True)
        http, own = free_port(), free_port()
        env = {k: v for k, v in os.environ.items() if not k.startswith("COSEG_")}
        env |= {"COSEG_ENDPOINT": f"ipc://{work}/s", "NO_COLOR": "1"}
        serve = [coseg, "serve", "--library", str(work / "library"), "--http", f"127.0.0.1:{http}"]
        (work / "prometheus.yml").write_text(
            "global: {scrape_interval: 1s}\nscrape_configs:\n  - job_name: coseg\n"
            f'    static_configs: [{{targets: ["127.0.0.1:{http}"]}}]\n'
        )
        watch = [str(work / "root/usr/bin/prometheus"), f"--config.file={work}/prometheus.yml", "--log.level=error"]
        watch += [f"--storage.tsdb.path={work}/tsdb", f"--web.listen-address=127.0.0.1:{own}"]
        running = [
            subprocess.Popen(serve, env=env, stderr=subprocess.DEVNULL),
            subprocess.Popen(watch, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL),
        ]
        try:
            api = f"http://127.0.0.1:{own}/api/v1"

            def ask(expression: str) -> dict[str, object]:
                url = f"{api}/query?{urllib.parse.urlencode({'query': expression})}"
                try:
                    found: dict[str, object] = json.loads(get(url))
                except urllib.error.HTTPError as e:
                    found = json.loads(e.read())
                return found

            def series(expression: str) -> int:
                data = ask(expression).get("data")
                return len(data["result"]) if isinstance(data, dict) else -1

            wait_for("Prometheus sees the daemon", lambda: series("coseg_ready == 1") == 1)
            synth = [coseg, "synth", "chair", "--count", "4", "--faces", "1000", "--out", str(work / "meshes")]
            subprocess.run(synth, env=env, check=True, capture_output=True)
            add = [coseg, "add", str(work / "meshes"), "--collection", "chairs", "--parts", "4", "--timeout", "60"]
            subprocess.run(add, env=env, check=True, capture_output=True)
            wait_for("all four are counted", lambda: series("sum(coseg_shapes_finished_total) == 4") == 1)
            questions = []
            for panel in json.loads(DASHBOARD.read_text())["panels"]:
                for target in panel.get("targets", []):
                    questions.append((panel["title"], target["expr"], True))
            questions += [("alert", html.unescape(a), False) for a in alerts()]
            for title, expression, wants_data in questions:
                filled = expression.replace("$instance", ".*").replace("$__rate_interval", "30s")
                empty_is_right = not wants_data or any(name in expression for name in MAY_BE_EMPTY)
                # A rate exists from the second scrape that has the counter, and one scrape is a second.
                end = time.monotonic() + 20
                while True:
                    answer = ask(filled)
                    n = series(filled) if answer["status"] == "success" else -1
                    good = n > 0 or (n == 0 and empty_is_right)
                    if good or time.monotonic() > end:
                        break
                    time.sleep(0.5)
                print(f"  {'ok' if good else 'FAIL':4} {title}: {n} series: {expression}")
                if not good:
                    faults.append(f"{title}: {expression}: {answer}")
            if len(questions) < 20:
                faults.append(f"only {len(questions)} questions were found")
            targets = json.loads(get(f"{api}/targets"))["data"]["activeTargets"]
            print("  scraped as", targets[0]["scrapePool"], targets[0]["health"], targets[0]["lastError"] or "without error")
            print(" ", model(work))
        finally:
            for process in running:
                process.terminate()
            for process in running:
                process.wait()
    for fault in faults:
        print(f"FAIL {fault}")
    print(f"{len(questions)} questions, {len(faults)} faults")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
