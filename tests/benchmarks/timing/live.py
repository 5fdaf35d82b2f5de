"""How punctual a live loop is while a page shows it, how late pictures are, what the loop costs.

- `exercise`, `practice` and `small` go through the page in a headless Chromium; a script there
  moves the mouse. The processor draws, not a graphics card, as many pictures as it can. `small` is
  the exercise in a window that is quickly drawn, and shows whether anything else delays pictures.
- `hand` is the exercise with a simulated hand and no page.
- `mesh` is the number of steps a second that free practice reaches on one core, in its own
  processor time.

A step is on time when it has ended before the next one is due. The delay from hand to picture ends
when the page has handed over the first picture that shows the mouse's event; drawing it, and a
screen, add their own time. `script` is the time of all JavaScript for each picture. `beside` is the
processor time of a step of the loop less that of its physics alone. The load is that of the minute
before: on an idle machine it is what this bench itself makes.
"""

from __future__ import annotations

import argparse
import math
import os
import pathlib
import shutil
import tempfile
import threading
import time

import mujoco
import numpy as np
from benchmarks import plots, results
from benchmarks.runner import Bench, Case, Row
from palpate import models, register
from palpate.app import live
from palpate.app.console import CommandError
from palpate.app.live.practice import Practice
from palpate.tasks import suite
from palpate.tasks.recording import Recording

TASK = "touch/hard"  # 1000 nodes
SECONDS = 30.0
KINDS = ("exercise", "practice", "small", "hand")
SCHEMES = ("implicit", "neumann", "explicit")
PICTURES, WAY, ON_TIME, BESIDE = 60, 0.1, 0.999, 30e-6  # asked for
WINDOW, SMALL = (900, 600), (480, 320)  # [pixels]
_BINS = (0, 20, 40, 60, 80, 100, 150, 200, 500, 1000, 10000)  # from hand to picture [ms]
_FLAGS = ("--no-sandbox", "--enable-unsafe-swiftshader")  # as where there is no graphics card
# Circles over the organ, and in and out of it.
_MOVE = """(() => {
  const canvas = document.getElementById("view"), box = canvas.getBoundingClientRect();
  const moves = "onpointerrawupdate" in window ? "pointerrawupdate" : "pointermove";
  const began = performance.now();
  const at = kind => {
    const t = (performance.now() - began) / 1000;
    const clientX = box.x + box.width / 2 + 30 * Math.sin(2 * t);
    const clientY = box.y + box.height / 2 + 20 * Math.cos(3 * t);
    canvas.dispatchEvent(new PointerEvent(kind, {pointerId: 1, clientX, clientY}));
    if (kind !== moves) return;
    const deltaY = -12 * Math.cos(1.5 * t);
    canvas.dispatchEvent(new WheelEvent("wheel", {deltaY, cancelable: true}));
  };
  at("pointerdown");
  clearInterval(window.mover);
  window.mover = setInterval(() => at(moves), 16);
})()"""
_COLUMNS = (
  *("kind", "mesh", "scheme", "nodes", "load", "seconds", "steps", "on_time", "median_us"),
  *("p99_us", "worst_us", "work_us", "late", "pictures", "script_ms"),
  *("way_ms", "way_95_ms", "ways"),
  *("beside_us", "rate_hz", "prepare_s"),
)


def stages(args: argparse.Namespace) -> list[list[Case]]:
  """Returns the cases."""
  seconds = 6.0 if args.short else SECONDS
  paced = [{"case": kind, "kind": kind, "seconds": seconds} for kind in KINDS]
  sides = models.GRIDS[:2] if args.short else models.GRIDS
  meshes = [
    {"case": f"mesh-{side}-{scheme}", "kind": "mesh", "mesh": side, "scheme": scheme}
    for side in sides
    for scheme in SCHEMES
  ]
  return [[*paced, {"case": "beside", "kind": "beside"}, *meshes]]


def run(case: Case, out: pathlib.Path) -> list[Row]:
  """Returns the row of a case."""
  register()
  load = os.getloadavg()[0]
  kinds = {"hand": _hand, "beside": _beside, "mesh": _mesh}
  row = kinds.get(case["kind"], _page)(case)
  return [{"kind": case["kind"], "load": load} | row]


def _hand(case: Case) -> Row:
  """Does the exercise with a simulated hand, without a page."""
  kwargs = {"input": "handle", "observations": ["joints"], "time_limit": case["seconds"]}
  env = suite.load(*suite.split(TASK), task_kwargs={"random": 0, **kwargs})
  made = live.Session(env, live.device("hand"), 0, {"task_kwargs": kwargs}).run(realtime=True)
  return _punctual([made.info["live"]]) | {"nodes": 1000}


def _punctual(summaries: list[dict]) -> Row:
  """Returns the numbers of several loops together."""
  steps = sum(s["steps"] for s in summaries)
  missed = sum(s["missed"] for s in summaries)
  late = np.sum([[count for _, count in s["late"]] for s in summaries], axis=0)
  edges = [low for low, _ in summaries[0]["late"]]
  return {
    "steps": steps,
    "seconds": steps / 1e3,
    "on_time": 1 - missed / steps,
    "median_us": float(np.median([s["median_us"] for s in summaries])),
    "p99_us": max(s["p99_us"] for s in summaries),
    "worst_us": max(s["worst_us"] for s in summaries),
    "work_us": sum(s["work_us"] * s["steps"] for s in summaries) / steps,
    "late": " ".join(f"{low}:{count}" for low, count in zip(edges, late, strict=True)),
  }


def _page(case: Case) -> Row:
  """Works through the page with a script."""
  try:
    from playwright.sync_api import sync_playwright
  except ImportError:
    raise CommandError("playwright is not installed: pip install 'palpate[test]'", code=1) from None
  path = shutil.which("chromium") or shutil.which("google-chrome")
  if path is None:
    raise CommandError("no chromium on this machine", code=1)
  from palpate.app.live.page.server import Server

  with tempfile.TemporaryDirectory() as folder, sync_playwright() as play:
    server = Server(pathlib.Path(folder))
    thread = threading.Thread(target=server.run, daemon=True)
    thread.start()
    browser = play.chromium.launch(executable_path=path, args=list(_FLAGS))
    width, height = SMALL if case["kind"] == "small" else WINDOW
    page = browser.new_page(viewport={"width": width, "height": height})
    page.goto(f"{server.url}#task={TASK}")
    page.wait_for_selector("#start:enabled", timeout=120e3)
    try:
      work = _practise if case["kind"] == "practice" else _train
      summaries, seen = work(page, case["seconds"], pathlib.Path(folder))
    finally:
      browser.close()
      server.close()
      thread.join(30)
  ways = np.concatenate([s["ways"] for s in seen])
  counts = np.histogram(ways, _BINS)[0]
  pictures = sum(len(s["pictures"]) for s in seen)
  return _punctual(summaries) | {
    "nodes": 1000,
    "pictures": pictures / sum(s["span"] for s in seen),
    "script_ms": 1e3 * sum(s["script"] for s in seen) / pictures,
    "way_ms": float(np.median(ways)),
    "way_95_ms": float(np.percentile(ways, 95)),
    "ways": " ".join(f"{low}:{count}" for low, count in zip(_BINS, counts, strict=False)),
  }


def _begin(page) -> None:
  page.click("#start")
  page.wait_for_selector("#stop:enabled", timeout=120e3)
  page.evaluate(_MOVE)


def _seen(page, seconds: float) -> dict:
  """Works for a time and returns what the page has seen in it."""
  count = "(({ways, pictures}) => [ways.length, pictures.length])(window.palpate())"
  session = page.context.new_cdp_session(page)
  session.send("Performance.enable")
  first, before, began = page.evaluate(count), _script(session), time.perf_counter()
  while time.perf_counter() - began < seconds and page.is_enabled("#stop"):
    page.wait_for_timeout(250)
  span = time.perf_counter() - began
  got = page.evaluate("(({ways, pictures}) => ({ways, pictures}))(window.palpate())")
  ways, pictures = got["ways"][first[0] :], got["pictures"][first[1] :]
  return {"span": span, "ways": ways, "pictures": pictures, "script": _script(session) - before}


def _script(session) -> float:
  """Returns the time that JavaScript has taken in the page since the session was enabled [s]."""
  metrics = session.send("Performance.getMetrics")["metrics"]
  return next(each["value"] for each in metrics if each["name"] == "ScriptDuration")


def _train(page, seconds: float, folder: pathlib.Path) -> tuple[list[dict], list[dict]]:
  """Does exercises one after another; their own recordings tell."""
  seen = []
  while sum(s["span"] for s in seen) < seconds - 1:
    if page.is_visible("#card[open]"):
      page.click("#card button:text('Close')")
    _begin(page)
    seen.append(_seen(page, seconds - sum(s["span"] for s in seen)))
    if page.is_enabled("#stop"):
      page.click("#stop")
    page.wait_for_selector("#card[open]", timeout=120e3)
  return [Recording.load(path).info["live"] for path in folder.glob("*.npz")], seen


def _practise(page, seconds: float, folder: pathlib.Path) -> tuple[list[dict], list[dict]]:
  page.click("#tab-practice")
  _begin(page)
  page.wait_for_timeout(1000)
  seen = _seen(page, seconds)
  page.click("#stop")
  page.wait_for_selector("#start:enabled", timeout=120e3)
  return [page.evaluate("window.palpate().late")], [seen]


def _beside(case: Case) -> Row:
  """Times the loop, and its physics alone on the same way, to the bit."""
  count, path = 4000, []
  spec = models.load("liver", instruments=("probe",), handle=True, coupling="window")
  model = spec.compile()

  def fresh() -> mujoco.MjData:
    data = mujoco.MjData(model)
    mujoco.mj_resetDataKeyframe(model, data, model.key("touch").id)
    mujoco.mj_forward(model, data)
    return data

  def spent(steps: int, keep: bool = False) -> float:
    data = fresh()
    hand = live.Hand(lambda t: (0.01 * math.sin(4 * t), 0.0, -0.004 * (1 - math.cos(2 * t))))
    loop = live.Loop(model, data, {"probe/": hand}, pace=live.Pace.instant())
    watch = (lambda loop: path.append((loop.links[0].row, data.ctrl.copy()))) if keep else None
    began = time.thread_time()
    loop.run(1e-3 * steps, watch)
    return time.thread_time() - began

  spent(count, keep=True)
  whole, physics, data = spent(count) - spent(0), 0.0, fresh()
  for row, ctrl in path:
    data.mocap_pos[0], data.mocap_quat[0], data.ctrl[:] = row[:3], row[3:], ctrl
    began = time.thread_time()
    mujoco.mj_step(model, data)
    physics += time.thread_time() - began
  return {"steps": count, "nodes": 1000, "beside_us": 1e6 * (whole - physics) / count}


def _mesh(case: Case) -> Row:
  """Steps free practice with a hand that presses, as fast as it goes."""
  began = time.perf_counter()
  practice = Practice(
    "liver", {"grid": case["mesh"]}, {"probe": live.device("hand")}, scheme=case["scheme"],
    pace=live.Pace.instant(),
  )  # fmt: skip
  row: Row = {"mesh": case["mesh"], "scheme": case["scheme"], "nodes": practice.organ.nvert}
  row["prepare_s"] = time.perf_counter() - began
  times: list[float] = []

  def stop(_) -> None:
    times.append(time.thread_time())
    long = len(times) >= 50 and times[-1] - times[10] > 1.0
    practice.pace.stopped = long or len(times) > 1000

  practice.run(watch=stop)
  steps = np.diff(times[10:])
  diverged = "; ".join(practice.faults)
  return row | {"rate_hz": "" if diverged else 1 / float(np.median(steps)), "steps": len(times)}


def _counts(text: str) -> tuple[list[float], list[int]]:
  low, count = zip(*(map(int, pair.split(":")) for pair in text.split()), strict=True)
  return list(low), list(count)


def draw(rows: list[Row], out: pathlib.Path) -> list[pathlib.Path]:
  """Draws both histograms of the loops."""
  paced = [r for r in rows if r["late"] != ""]
  if not paced:
    return []
  figure, axes = plots.grid(1, 2, width=9.0, height=3.2)
  for ax, key, unit in ((axes[0], "late", "us"), (axes[1], "ways", "ms")):
    mine = [r for r in paced if r[key] != ""]
    for i, row in enumerate(mine):
      low, count = _counts(row[key])
      share = np.maximum(np.array(count) / max(sum(count), 1), 1e-6)
      width = 0.8 / len(mine)
      ax.bar(np.arange(len(low)) + width * i, share, 0.9 * width, label=row["kind"])
      ax.set_xticks(np.arange(len(low)), [f"{x:g}" for x in low], rotation=60)
    ax.set(yscale="log", ylim=(1e-6, 1), xlabel=f"at least [{unit}]", ylabel="share")
  axes[0].set_title("how late a step began", loc="left", fontsize=9)
  axes[1].set_title("from hand to picture", loc="left", fontsize=9)
  axes[0].legend(fontsize=8, frameon=False)
  return [plots.save(figure, out / "live.png", "A live loop while a page shows it")]


def finding(rows: list[Row]) -> list[str]:
  """Returns what the page begins with."""
  lines = []
  for row in rows:
    if row["kind"] in ("exercise", "practice") and row["late"] != "":
      lines.append(f"In `{row['kind']}` {100 * row['on_time']:.2f} % of the steps of 1 ms are on "
                   f"time; a hand's motion is in the picture after {row['way_ms']:.0f} ms "
                   "(median).")  # fmt: skip
  cost = [row["beside_us"] for row in rows if row["kind"] == "beside"]
  return [*lines, *(f"The loop costs {us:.0f} us a step beside physics." for us in cost)][:3]


def report(rows: list[Row], path: pathlib.Path) -> results.Page:
  """Draws the figure and writes the page."""
  paced = sorted((r for r in rows if r["late"] != ""), key=lambda row: KINDS.index(row["kind"]))
  head = ["", "load", "steps", "on time", "median", "99 %", "worst", "work"]
  head += ["pictures a second", "script", "hand to picture", "95 %"]
  table = []
  for r in paced:
    late = f"{r['median_us']:.0f} us", f"{r['p99_us']:.0f} us", f"{1e-3 * r['worst_us']:.1f} ms"
    line = [r["kind"], f"{r['load']:.1f}", str(r["steps"]), f"{100 * r['on_time']:.2f} %", *late]
    seen = [""] * 4
    if r["ways"] != "":
      script = f"{r['script_ms']:.1f} ms" if r["script_ms"] != "" else ""
      seen = f"{r['pictures']:.1f}", script, f"{r['way_ms']:.0f} ms", f"{r['way_95_ms']:.0f} ms"
    table.append([*line, f"{r['work_us']:.0f} us", *seen])
  lines = [str(__doc__).partition("\n\n")[2], "", *plots.table(head, table), ""]
  for r in rows:
    if r["kind"] == "beside":
      lines += [f"The loop costs {r['beside_us']:.1f} us a step beside physics.", ""]
  meshes = {(r["mesh"], r["scheme"]): r for r in rows if r["kind"] == "mesh"}
  cells = []
  for side in sorted({side for side, _ in meshes}):
    mine = [meshes.get((side, scheme)) for scheme in SCHEMES]
    some = next(filter(None, mine))
    ready = f"{some['prepare_s']:.0f} s"
    cells.append([f"{side} x {side}", str(some["nodes"]), ready, *map(_rate, mine)])
  lines += ["Steps a second of free practice, at steps of 1 ms:", ""]
  lines += [*plots.table(["mesh", "nodes", "made ready in", *SCHEMES], cells), ""]
  wanted = f"{100 * ON_TIME} % on time, {PICTURES} pictures a second on a laptop's graphics card"
  lines += [f"Asked for: {wanted}, {1e3 * WAY:.0f} ms, {1e6 * BESIDE:.0f} us.", ""]
  lines += [results.link(path)]
  return results.Page("A live loop", finding(rows), lines, draw(rows, path.parent))


def _rate(row: Row | None) -> str:
  if row is None:
    return "-"
  return "diverges" if row["rate_hz"] == "" else f"{row['rate_hz']:.0f}"


BENCH = Bench("live", stages, run, _COLUMNS, report)
