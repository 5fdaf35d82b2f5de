"""The report page: what it says, that it stands alone, and that it survives odd recordings."""

import base64
import html.parser
import io
import json
import math
import re
import struct
import subprocess
import sys

import numpy as np
import pytest
from palpate.tasks.metrics import METRICS, Metrics, number
from palpate.tasks.people import plots, report
from palpate.tasks.people.score import make_reference
from palpate.tasks.recorder import Recorder, Settings
from PIL import Image

pytest.importorskip("matplotlib")

VOID = {"meta", "img", "br", "link"}
NASTY = "<script>alert('x')</script> & \"$\\frac{1\" _"


@pytest.fixture
def real_png():
  """Asks for real pictures: rasterising them is most of the time of a page."""


@pytest.fixture(autouse=True)
def _quick_png(request, monkeypatch):
  if "real_png" not in request.fixturenames:
    monkeypatch.setattr(report, "png", lambda figure: b"\x89PNG")


class _Page(html.parser.HTMLParser):
  """Collects text, tables and pictures; fails on tags that do not nest."""

  def __init__(self, text):
    super().__init__()
    self.open, self.tags, self.words, self.rows, self.images = [], set(), [], [], []
    self.feed(text)
    self.close()
    assert self.open == []

  def handle_starttag(self, tag, attrs):
    self.tags.add(tag)
    if tag not in VOID:
      self.open.append(tag)
    if tag == "tr":
      self.rows.append([])
    if tag in ("td", "th"):
      self.rows[-1].append("")
    if tag == "img":
      self.images.append(dict(attrs))

  def handle_endtag(self, tag):
    assert self.open.pop() == tag

  def handle_data(self, data):
    if "style" not in self.open:
      self.words.append(data)
    if self.open and {"td", "th"} & set(self.open):
      self.rows[-1][-1] += data

  def row(self, first):
    found = [r for r in self.rows if r[0] == first and len(r) > 1]
    assert len(found) == 1, first
    return found[0]

  def text(self):
    return " ".join(" ".join(self.words).split())


def _recorder(instruments=("probe",), limit=1.5, peak=2.0, **kwargs):
  recorder = Recorder(
    instruments,
    Settings(force_limit=limit, reference_length=0.1),
    info={"task": "touch", "seed": 3, "outcome": "success"},
    watch=["drop"],
    **kwargs,
  )
  count = len(instruments)
  for k in range(101):
    s = k / 100
    point = [0.12 * s, 0.01 * np.sin(6 * s), 0.02]
    angle = s * np.pi / 8  # half of a turn of 45 degrees
    recorder.append(
      0.02 * k,
      [point] * count,
      quat=[[np.cos(angle), np.sin(angle), 0, 0]] * count,
      force=[max(0.0, peak * np.sin(2 * np.pi * s))] * count,
    )
  recorder.event("target", 0.5, 0.0015, label="first")
  return recorder


def _reference(**rows):
  worse = {name: -2 if spec.better == "higher" else 2 for name, spec in METRICS.items()}
  table = {
    k: {"mean": mean, "sd": sd, "n": 9, "limit": mean + worse[k] * (sd or 0)}
    for k, (mean, sd) in rows.items()
  }
  return {
    "format": "palpate-reference",
    "version": 2,
    "task": "touch",
    "performer": "skilled",
    "seed": 41,
    "n": 9,
    "metrics": table,
  }


def test_the_page_stands_alone(tmp_path, real_png):
  path = report.write_report(_recorder().recording(), tmp_path / "new" / "folder")
  assert path == tmp_path / "new" / "folder" / "report.html"
  assert [p.name for p in path.parent.iterdir()] == ["report.html"]
  text = path.read_text(encoding="utf-8")
  page = _Page(text)
  assert not page.tags & {"script", "link", "iframe", "object"}
  assert not re.search(r"(src|href)\s*=\s*['\"](?!data:image/png;base64,)", text)
  assert "@import" not in text and "url(" not in text
  assert len(page.images) == 3 and all(image["alt"] for image in page.images)
  for image in page.images:
    data = base64.b64decode(image["src"].split(",")[1], validate=True)
    assert data.startswith(b"\x89PNG")
    width, height = struct.unpack(">II", data[16:24])
    assert width > 600 and height > 300


def test_people_see_millimetres_and_degrees():
  recording = _recorder().recording()
  page = _Page(report.render(recording))
  length = 1e3 * recording.metrics().path_length
  assert page.row("Path length")[1:4] == [f"{length:.3g}", "mm", "lower"]
  assert page.row("Angular path")[1:3] == ["45", "deg"]
  assert page.row("Peak force")[1:3] == ["2", "N"]
  assert page.row("Smoothness (SPARC)")[3] == "\N{EN DASH}"
  assert page.row("Smoothness (SPARC)")[1].startswith("−")  # a minus, not a hyphen
  assert page.row("0.5") == ["0.5", "target", "1.5 mm", "probe", "first"]
  assert page.row("Target error")[1] == "1.5"
  assert "No reference was given" in page.text()
  assert "no curve to trace" in page.text()
  assert "z" not in page.row("metric")


def test_the_score_is_explained():
  reference = _reference(time=(1.0, 0.25), path_length=(0.1, 0.02), peak_force=(1.5, 0.5))
  page = _Page(report.render(_recorder().recording(), reference))
  assert page.row("metric")[-3:] == ["panel mean ± SD", "limit", "z"]
  assert page.row("Time to completion")[1:] == ["2", "s", "lower", "1 ± 0.25", "≤ 1.5", "−4 over"]
  assert page.row("Peak force")[-3:] == ["1.5 ± 0.5", "≤ 2.5", "−1"]
  assert page.row("Path length")[4:6] == ["100 ± 20", "≤ 140"]
  assert page.row("RMS force in contact")[-3:] == ["–", "–", "–"]
  assert page.row("safety")[1:4] == ["67 %", "75 %", "−1"]
  assert page.row("efficiency")[1] == "17 %"
  assert page.row("dexterity")[1:] == ["5.33 %", "0 %", "–", "–"]
  text = page.text()
  assert "remaining 16 % are for time, dexterity and outcome" in text
  assert "not proficient; over the limit: Time to completion" in text
  assert "task touch, performer skilled, n 9, seed 41" in text
  total = sum(float(page.row(g)[4].replace("−", "-")) for g in ("safety", "efficiency", "time"))
  shown = float(re.search(r"Score (−?[\d.]+) not", text)[1].replace("−", "-"))
  assert shown == pytest.approx(total, abs=0.016)  # three roundings to 0.01


def test_higher_is_better_is_bounded_from_below():
  page = _Page(
    report.render(_recorder().recording(), _reference(log_dimensionless_jerk=(-1.5, 0.1)))
  )
  assert page.row("Log dimensionless jerk")[5] == "≥ −1.7"
  assert "No composite score" in page.text() and "no safety" in page.text()


def test_what_the_expert_has_and_the_recording_lacks_is_shown():
  reference = _reference(peak_force=(1.5, 0.5), grasp_slips=(0.0, 0.0), trace_rms=(0.001, None))
  page = _Page(report.render(_recorder().recording(), reference))
  assert page.row("Grasp slips")[1:] == ["–", "count", "lower", "0 ± 0", "≤ 0", "–"]
  assert page.row("Tracing error (RMS)")[4:] == ["1 ± ?", "≤ 1", "–"]
  assert "unknown: Grasp slips, Tracing error (RMS)" in page.text()


@pytest.mark.parametrize(
  ("outcome", "said"),
  [
    ("damage", "Failed: tissue was harmed, after 2 s"),
    ("time limit", "Failed: the time ran out, after 2 s"),
    ("missed", "Failed: it was missed, after 2 s"),
    ("stopped", "Stopped before the end, after 2 s"),
    ("dropped the needle", "Failed: dropped the needle, after 2 s"),
    ("error", "after 2 s: ValueError: action is nan"),
  ],
)
def test_the_head_says_what_happened_and_a_failure_has_no_number(outcome, said):
  recorder = _recorder()
  again = [_recorder(peak=p).metrics() for p in (1.8, 2.0, 2.2)]
  recorder.info["outcome"] = outcome
  if outcome == "error":
    recorder.info["error"] = "ValueError: action is nan"
  text = _Page(report.render(recorder.recording(), make_reference(again, "touch", 0))).text()
  head = text[: text.index("Score")]
  assert said in head and "Success" not in head
  assert "Score not done not proficient; it did not succeed" in text
  recorder.info["outcome"] = "success"
  assert "Success, after 2 s" in _Page(report.render(recorder.recording())).text()
  del recorder.info["outcome"]
  text = _Page(report.render(recorder.recording(), make_reference(again, "touch", 0))).text()
  assert "How it ended was not recorded" in text
  assert "No composite score : the recording does not say how it ended" in text


def test_what_a_live_exercise_has_noted_is_told_in_words():
  recorder = _recorder()
  recorder.info["coach"] = {"assessment": False, "hints": [{"time": 1.5, "text": "Press less"}]}
  recorder.info["live"] = {"on_time": 0.998, "steps": 2000, "faults": ["udp: it is gone"]}
  text = _Page(report.render(recorder.recording())).text()
  assert "coach 1.5 s: Press less live 99.8 % of 2000 steps on time; udp: it is gone" in text
  recorder.info["task_kwargs"] = {"observations": ["joints", "target"], "radius": 0.006}
  text = _Page(report.render(recorder.recording())).text()
  assert "options observations = joints, target; radius = 0.006" in text


def test_the_head_says_what_harmed_tissue():
  recorder = _recorder()
  recorder.event("note", 2.0, label="torn by a pull of 1.20 N")
  recorder.info["outcome"] = "damage"
  text = _Page(report.render(recorder.recording())).text()
  assert "Failed: torn by a pull of 1.20 N, after 2 s" in text[: text.index("Metrics")]


def test_a_film_is_in_the_page():
  text = report.render(_recorder().recording(), film=b"\0\0ftyp")
  page = _Page(text)
  assert "video" in page.tags and not page.tags & {"script", "link", "iframe", "object"}
  data = re.search(r"<video [^>]*src='data:video/mp4;base64,([^']*)'", text)[1]
  assert base64.b64decode(data, validate=True) == b"\0\0ftyp"
  assert text.index("<video ") < text.index("<h2>")  # the operation comes first


def test_pictures_of_the_operation_come_first_in_the_page():
  shown = np.zeros((2, 24, 80, 3), np.uint8)
  shown[1] = 255
  text = report.render(_recorder().recording(), pictures=shown)
  assert text.rindex("what the laparoscope saw") < text.index("<h2>")
  found = re.findall(r"<img [^>]*src='data:image/jpeg;base64,([^']*)'", text)
  for data, each in zip(found, shown, strict=True):
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(data, validate=True))))
    assert picture.shape == each.shape and np.abs(picture.astype(int) - each).max() < 10


def test_a_grasper_s_grip_and_pull_are_two_lines():
  recorder = Recorder(settings=Settings(force_limit=4.0), substeps=20)
  for k in range(50):
    recorder.append(0.02 * k, [0.001 * k, 0, 0], force=0.4, grip_force=2.4, shaft_force=0.1)
  axes = plots.force_figure(recorder.recording()).axes[0]
  labels = [t.get_text() for t in axes.legend_.texts]
  assert labels == ["press or pull", "grip", "shaft", "limit 4 N"]
  assert len(axes.lines[0].get_xdata()) == 49 * 20 + 1  # at the physics' rate


def test_a_good_performance_is_proficient():
  recorder = _recorder()
  again = [_recorder(peak=p).metrics() for p in (1.8, 2.0, 2.2)]
  page = _Page(report.render(recorder.recording(), make_reference(again, "touch", 0)))
  assert "proficient: every metric within its limit" in page.text()


@pytest.mark.parametrize("place", ["info", "label", "title", "name"])
def test_user_text_is_escaped(place, tmp_path):
  recorder = _recorder((NASTY,) if place == "name" else ("probe",))
  if place == "info":
    recorder.info = {"task": NASTY, NASTY: NASTY}
  if place == "label":
    recorder.event("note", 1.0, label=NASTY)
  text = report.render(
    recorder.recording(), _reference(time=(1, 1)), title=NASTY if place == "title" else None
  )
  assert "<script" not in text and "alert('x')" not in text
  assert NASTY in html.unescape(text)
  _Page(text)


def test_user_text_in_plots_is_no_formula(real_png):
  for text in ("$\\frac{1}$", "$_{$", "a" * 80, "_hidden", "", "\\", "$$$", "π ≤ 3"):
    recorder = _recorder((text, "other"))
    recorder.event("note", 1.0, label=text)
    for draw in (plots.force_figure, plots.spectrum_figure):
      assert plots.png(draw(recorder.recording())).startswith(b"\x89PNG")
  names = [t.get_text() for t in plots.force_figure(recorder.recording()).axes[0].legend_.texts]
  assert names[0] == "π ≤ 3"


def test_several_instruments_have_their_columns():
  page = _Page(report.render(_recorder(("left", "right")).recording()))
  assert page.row("metric")[:4] == ["metric", "value", "left", "right"]
  total, left, right = (float(v) for v in page.row("Path length")[1:4])
  assert total == pytest.approx(left + right, rel=0.01)
  assert page.row("Bimanual dexterity")[1:4] == ["1", "–", "–"]


# Figures.


def test_force_figure_shows_force_and_limit():
  axes = plots.force_figure(_recorder().recording()).axes[0]
  line = axes.lines[0]
  assert line.get_ydata().max() == pytest.approx(2.0) and line.get_xdata()[-1] == pytest.approx(2)
  labels = [t.get_text() for t in axes.legend_.texts]
  assert labels == ["contact force", "over the limit", "limit 1.5 N"]
  below = plots.force_figure(_recorder(limit=5.0).recording()).axes[0]
  assert [t.get_text() for t in below.legend_.texts] == ["contact force", "limit 5 N"]
  assert below.get_ylim()[1] > 5  # a limit that was kept is still in the picture
  without = plots.force_figure(_recorder(limit=None).recording()).axes[0]
  assert [t.get_text() for t in without.legend_.texts] == ["contact force"]


def test_spectrum_figure_shows_the_cut_offs():
  recording = _recorder().recording()
  axes = plots.spectrum_figure(recording).axes[0]
  labels = [t.get_text() for t in axes.legend_.texts]
  assert labels[0] == f"SPARC −{abs(round(recording.metrics().sparc, 2)):.3g}"
  assert labels[1:] == ["10 Hz", "amplitude 0.05"]
  whole, selected = axes.lines[:2]
  assert len(selected.get_xdata()) < len(whole.get_xdata())
  assert selected.get_ydata()[-1] >= 0.05 and selected.get_xdata()[-1] <= 10


def test_the_spectrum_of_a_noisy_tracker_is_that_of_the_metric():
  recorder, rng = Recorder(), np.random.RandomState(0)
  for k in range(400):
    recorder.append(0.01 * k, [0.05 * np.sin(k / 60), *(5e-4 * rng.randn(2))])
  recording = recorder.recording()
  label = plots.spectrum_figure(recording).axes[0].legend_.texts[0].get_text()
  assert label == f"SPARC {number(round(recording.metrics().sparc, 2))}"


def test_path_figure_is_in_millimetres_over_the_surface():
  recorder = _recorder()
  recorder.attach("vertices", [[0, 0, 0], [0.2, 0, 0], [0, 0.3, 0], [0, 0, 0.05]])
  recorder.attach("triangles", [[0, 1, 2], [0, 1, 3]])
  recorder.attach("curve", [[0, 0, 0], [0.1, 0.1, 0]])
  axes = plots.path_figure(recorder.recording()).axes[0]
  x, _, z = axes.lines[1].get_data_3d()  # after the curve
  assert x.max() == pytest.approx(120) and z.max() == pytest.approx(20)
  assert axes.get_ylim()[1] >= 300 and len(axes.collections) == 1
  spans = np.array([np.ptp(getattr(axes, f"get_{a}lim")()) for a in "xyz"])
  box = np.array(axes._box_aspect)
  np.testing.assert_allclose(spans / box, (spans / box)[0])  # equal scales
  recorder.attach("triangles", [[0, 1, 4]])
  with pytest.raises(ValueError, match="indices of the 4 vertices"):
    plots.path_figure(recorder.recording())


def test_colour_marks_contact():
  recording = _recorder().recording()
  axes = plots.path_figure(recording).axes[0]
  labels = [line.get_label() for line in axes.lines]
  x = axes.lines[labels.index("in contact")].get_data_3d()[0]
  np.testing.assert_array_equal(np.isfinite(x), recording.force() > 0)


# Odd recordings.


def _odd(kind):
  recorder = Recorder(settings=Settings(force_limit=1.0), info={"outcome": "success"})
  if kind == "one":
    recorder.append(0.0, [0, 0, 0], force=0.5)
  for k in range(20 if kind not in ("empty", "one") else 0):
    point = {"still": [0, 0, 0], "lost": [math.nan] * 3}.get(kind, [0.01 * k, 0, 0])
    if kind == "gap" and 5 < k < 9:
      point = [math.nan] * 3
    force = {"light": 0.0, "gap": math.nan if k == 3 else 1.5, "unfelt": None}.get(kind, 0.4)
    recorder.append(10 + 0.02 * k, point, force=force)
  recorder.event("target", 10.1, 0.001)
  return recorder.recording()


@pytest.mark.parametrize("kind", ["empty", "one", "still", "lost", "gap", "light", "unfelt"])
def test_odd_recordings_make_a_page(kind, real_png):
  reference = make_reference([_recorder(peak=p).metrics() for p in (1.0, 2.0)], "touch", 0)
  page = _Page(report.render(_odd(kind), reference))
  text = page.text()
  assert not re.search(r"\bnan\b", text, re.IGNORECASE)
  expected = {
    "empty": (0, "the recording is empty"),
    "one": (2, "too few samples"),
    "still": (2, "no motion"),
    "lost": (1, "tip_pos not recorded"),
    "gap": (2, "tip_pos is not finite at sample 6"),
    "light": (3, "no contact"),
    "unfelt": (2, "force not recorded"),
  }
  count, reason = expected[kind]
  assert len(page.images) == count and reason in text
  assert "proficient: every" not in text
  # Without one known metric of safety there is no score.
  assert ("No composite score" in text) == (kind in ("empty", "gap", "light", "unfelt"))


def test_many_events_are_cut_and_counted():
  recorder = _recorder()
  for k in range(80):
    recorder.event("note", 0.01 * k)
  page = _Page(report.render(recorder.recording()))
  assert "and 31 more" in page.text()
  few = plots.force_figure(recorder.recording()).axes[0]
  assert [len(c.get_segments()) for c in few.collections if hasattr(c, "get_segments")] == [80]
  for k in range(80, 2000):
    recorder.event("note", 0.001 * k)
  many = plots.force_figure(recorder.recording()).axes[0]  # each line costs a millisecond
  assert not [c for c in many.collections if hasattr(c, "get_segments")]
  plots.png(many.figure)


def test_a_bad_reference_writes_nothing(tmp_path):
  with pytest.raises(ValueError, match="palpate-reference"):
    report.write_report(_recorder().recording(), tmp_path, {"format": "x"})
  assert list(tmp_path.iterdir()) == []


def test_every_metric_can_be_shown():
  known = Metrics(**{name: 1.25 for name in METRICS})
  for name, spec in METRICS.items():
    text = number(getattr(known, name), spec)
    assert float(text) == pytest.approx(1.25 * spec.scale, rel=5e-3)
  assert number(123456.7) == "123457" and number(-0.5) == "−0.5"
  assert number(3.0, METRICS["errors"]) == "3"
  assert number(math.nan) == "–"
  assert json.loads(known.to_json())["values"]["time"] == 1.25


LATE = """
import sys
from palpate.tasks import recorder
from palpate.tasks.people import report
assert "matplotlib" not in sys.modules
r = recorder.Recorder()
for k in range(9):
  r.append(k * 0.1, [k, 0, 0])
"""


def _fresh(code):
  done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
  assert done.returncode == 0, done.stderr
  return done.stdout


def test_a_missing_matplotlib_is_named():
  code = """
sys.modules["matplotlib"] = None
try:
  report.render(r.recording())
except ImportError as error:
  print(error)
"""
  assert "pip install 'palpate[plot]'" in _fresh(LATE + code)


def test_the_caller_s_backend_is_left_alone():
  code = """
report.render(r.recording())
print("matplotlib" in sys.modules, "matplotlib.pyplot" in sys.modules)
"""
  assert _fresh(LATE + code).split() == ["True", "False"]
