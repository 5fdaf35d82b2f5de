"""The recorder and its file."""

import dataclasses
import io
import json
import math
import os
import zipfile

import numpy as np
import pytest
from palpate.tasks import recorder as recorder_module
from palpate.tasks.metrics import METRICS
from palpate.tasks.people.score import read_reference
from palpate.tasks.recorder import Event, Recorder, Recording, Settings
from recordings import SETTINGS, exercise


def _same_bits(a, b):
  assert a.dtype == b.dtype and a.shape == b.shape
  assert a.tobytes() == b.tobytes()


def _same_tables(a, b):
  for table in ("columns", "arrays", "constants"):
    old, new = getattr(a, table), getattr(b, table)
    assert old.keys() == new.keys() and old
    for name in old:
      _same_bits(new[name], old[name])


# The file.


def test_round_trip_is_exact(tmp_path):
  made = exercise()
  path = made.save(tmp_path / "exercise.npz")
  before, after = made.recording(), Recording.load(path)
  _same_bits(after.time, before.time)
  _same_tables(before, after)
  for field in ("events", "instruments", "settings", "watch", "info"):
    assert getattr(after, field) == getattr(before, field)
  assert after.arrays["action"].dtype == np.float32
  assert after.metrics() == made.metrics()
  assert after.metrics(1) == made.metrics(1) != made.metrics(0)
  known = set(METRICS) - set(after.metrics().reasons())
  assert known == set(METRICS)  # the comparison compared something everywhere
  again = after.save(tmp_path / "again.npz")
  assert Recording.load(again).metrics() == made.metrics()


def test_a_journal_is_the_recording_until_it_is_saved(tmp_path):
  """Parts that were written while it went on make it, to the bit; half a part is left out."""
  path = tmp_path / "exercise.npz"
  made = exercise(60, journal=path)
  made.close()
  whole, parts = made.recording(), Recording.load(path)
  assert parts.outcome == "interrupted"
  assert Recording.load_info(path) == parts.info == {**whole.info, "outcome": "interrupted"}
  _same_bits(parts.time, whole.time)
  _same_tables(whole, parts)
  ended = dataclasses.replace(whole, info=parts.info)
  assert parts.events == whole.events and parts.metrics() == ended.metrics()
  data = path.read_bytes()
  assert data.count(b"PART") >= 2
  path.write_bytes(data[:-100])
  assert 0 < len(Recording.load(path).time) < 60
  path.write_bytes(data[:100])
  with pytest.raises(ValueError, match="no part of it is complete"):
    Recording.load(path)
  whole.save(path)
  assert Recording.load(path).outcome is None


def test_the_file_needs_no_pickle(tmp_path):
  path = exercise(5).save(tmp_path / "exercise.npz")
  with np.load(path, allow_pickle=False) as archive:
    meta = json.loads(str(archive["meta"][()]))
    assert all(archive[name].dtype.kind in "fiubU" for name in archive.files)
  assert (meta["format"], meta["version"]) == ("palpate-recording", 2)


def test_empty_and_single_sample(tmp_path):
  empty = Recording.load(Recorder().save(tmp_path / "empty.npz"))
  assert len(empty.time) == 0
  assert set(empty.metrics().reasons().values()) == {"the recording is empty"}
  one = Recorder(settings=SETTINGS)
  one.append(0.0, [0, 0, 0], force=2.0)
  loaded = Recording.load(one.save(tmp_path / "one.npz"))
  assert loaded.metrics() == one.metrics()
  assert loaded.metrics().peak_force == 2.0 and loaded.metrics().force_breaches == 1
  assert "too few samples" in loaded.metrics().reasons()["time"]


def test_saving_replaces_whole_files_only(tmp_path, monkeypatch):
  path = tmp_path / "exercise.npz"
  made = exercise(20)
  made.save(path)
  old = path.read_bytes()

  def broken(file, **entries):
    file.write(b"half")
    raise OSError("no space left on device")

  monkeypatch.setattr(np, "savez_compressed", broken)
  with pytest.raises(OSError, match="no space"):
    exercise(30).save(path)
  assert path.read_bytes() == old
  assert os.listdir(tmp_path) == ["exercise.npz"]
  monkeypatch.undo()
  exercise(30).save(path)
  assert len(Recording.load(path).time) == 30
  with pytest.raises(FileNotFoundError):
    made.save(tmp_path / "nowhere" / "exercise.npz")
  with pytest.raises(FileNotFoundError):
    Recording.load(tmp_path / "nothing.npz")


@pytest.mark.parametrize("content", [b"", b"P", b"PK", b"PK\x03\x04rubbish", b"hello world"])
def test_foreign_bytes_are_refused(tmp_path, content):
  path = tmp_path / "foreign.npz"
  path.write_bytes(content)
  with pytest.raises(ValueError, match=r"foreign\.npz: not a"):
    Recording.load(path)


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes here")
def test_a_pipe_is_refused_and_not_waited_for(tmp_path):
  os.mkfifo(tmp_path / "pipe.npz")
  for read in (Recording.load, read_reference):
    with pytest.raises(ValueError, match=r"pipe.npz: not a .*: not a file"):
      read(tmp_path / "pipe.npz")


def test_a_recording_that_declares_too_much_is_refused_unread(tmp_path):
  path = exercise(40).save(tmp_path / "large.npz")
  with zipfile.ZipFile(path, "a") as archive:
    archive.writestr("array.large.npy", b"")
    archive.filelist[-1].file_size = 2**40
  with pytest.raises(ValueError, match=r"large.npz: .*declares 10995\d+ bytes, expected at most"):
    Recording.load(path)


def test_truncated_files_are_refused(tmp_path):
  data = exercise(40).save(tmp_path / "whole.npz").read_bytes()
  path = tmp_path / "cut.npz"
  for size in np.linspace(0, len(data) - 1, 40).astype(int):
    path.write_bytes(data[:size])
    with pytest.raises(ValueError, match=r"cut\.npz"):
      Recording.load(path)


def test_flipped_bytes_are_refused_or_harmless(tmp_path):
  made = exercise(40)
  data = made.save(tmp_path / "whole.npz").read_bytes()
  path = tmp_path / "flipped.npz"
  rng = np.random.RandomState(0)
  refused = 0
  for at in rng.randint(0, len(data), 150):
    broken = bytearray(data)
    broken[at] ^= 1 << rng.randint(8)
    path.write_bytes(broken)
    try:
      loaded = Recording.load(path)
    except ValueError as error:
      assert "flipped.npz" in str(error)
      refused += 1
    else:  # a date or another field that nothing depends on
      assert loaded.metrics() == made.metrics()
      for name, value in made.recording().arrays.items():
        _same_bits(loaded.arrays[name], value)
  assert refused > 100


def _rewrite(source, target, change):
  """Copies a recording with its entries changed by `change(entries, meta)`."""
  with np.load(source, allow_pickle=False) as archive:
    entries = {name: archive[name] for name in archive.files}
  meta = json.loads(str(entries["meta"][()]))
  change(entries, meta)
  if "meta" in entries:
    entries["meta"] = np.array(json.dumps(meta))
  np.savez(target, allow_pickle=True, **entries)


def _set(table, key, value):
  return lambda entries, meta: (entries if table == "entries" else meta).update({key: value})


EVENT = {"kind": "drop", "time": 1.0, "value": None, "instrument": 0, "label": ""}


@pytest.mark.parametrize(
  ("change", "match"),
  [
    (lambda e, m: e.pop("meta"), "no entry 'meta'"),
    (lambda e, m: e.pop("time"), "no entry 'time'"),
    (_set("meta", "format", "other"), "format is 'other'"),
    (_set("meta", "version", 99), "version is 99, this program reads 2"),
    (_set("meta", "instruments", []), "instruments is"),
    (lambda e, m: m.update(instruments=["one"], events=[]), "column .* is float64"),
    (_set("meta", "info", 3), "info is 3"),
    (_set("meta", "substeps", 0), "substeps is 0"),
    (_set("meta", "substeps", 5), "column .*force is float64"),
    (_set("meta", "watch", ["explosion"]), "no event 'explosion'"),
    (_set("meta", "settings", {"force_limit": -1}), "force_limit is -1"),
    (_set("meta", "settings", {"gravity": 1}), "gravity"),
    (_set("meta", "events", [EVENT | {"kind": "party"}]), "no event 'party'"),
    (_set("meta", "events", [EVENT | {"instrument": 2}]), "instrument is 2 of 2"),
    (_set("meta", "events", [EVENT | {"time": None}]), "time is None"),
    (_set("meta", "events", [EVENT | {"label": 3}]), "label is 3"),
    (_set("entries", "time", np.zeros(20)), "time does not increase at sample 1"),
    (_set("entries", "time", np.arange(19) * 1.0), "expected 19 samples"),
    (_set("entries", "column.tip_pos", np.zeros((20, 2, 4))), "column tip_pos is"),
    (_set("entries", "column.tip_pos", np.zeros((20, 2, 3), "f4")), "column tip_pos is float32"),
    (_set("entries", "column.charm", np.zeros((20, 2))), "unknown column 'charm'"),
    (_set("entries", "array.qpos", np.array([{}] * 20)), "allow_pickle"),
    (_set("entries", "array.qpos", np.array(["x"] * 20)), "dtype <U1"),
    (_set("entries", "array.qpos", np.zeros(())), "expected 20 samples"),
    (_set("entries", "constant.curve", np.zeros(3)), "'curve' has shape"),
    (_set("entries", "constant.curve", np.full((4, 3), np.nan)), "'curve' is not finite in row 0"),
    (_set("entries", "stranger", np.zeros(20)), "unknown entry 'stranger'"),
  ],
)
def test_foreign_content_is_named(tmp_path, change, match):
  source = exercise(20).save(tmp_path / "good.npz")
  _rewrite(source, tmp_path / "same.npz", lambda entries, meta: None)
  Recording.load(tmp_path / "same.npz")  # the copying itself does no harm
  _rewrite(source, tmp_path / "bad.npz", change)
  with pytest.raises(ValueError, match=match) as error:
    Recording.load(tmp_path / "bad.npz")
  assert "bad.npz" in str(error.value)


def test_a_pickle_in_the_archive_is_not_run(tmp_path):
  class Trap:
    def __reduce__(self):
      return os.mkdir, (str(tmp_path / "sprung"),)

  buffer = io.BytesIO()
  np.lib.format.write_array(buffer, np.array(Trap(), object), allow_pickle=True)
  path = tmp_path / "trap.npz"
  with zipfile.ZipFile(path, "w") as archive:
    archive.writestr("meta.npy", buffer.getvalue())
    archive.writestr("time.npy", buffer.getvalue())
  with pytest.raises(ValueError, match="trap"):
    Recording.load(path)
  assert not (tmp_path / "sprung").exists()


# Recording.


def test_growth_keeps_every_sample():
  recorder = Recorder()
  rows = np.random.RandomState(1).rand(1000, 3)
  views = []
  for k, row in enumerate(rows):
    recorder.append(k * 0.1, row, arrays={"q": row[:2]})
    if k in (10, 255, 256, 700):
      views.append(recorder.recording())
  full = recorder.recording()
  np.testing.assert_array_equal(full.columns["tip_pos"][:, 0], rows)
  np.testing.assert_array_equal(full.arrays["q"], rows[:, :2])
  for view in views:  # earlier views still hold what they held
    np.testing.assert_array_equal(view.columns["tip_pos"][:, 0], rows[: len(view.time)])
  with pytest.raises(ValueError, match="read-only"):
    full.time[0] = 1
  assert len(recorder) == 1000


def test_what_is_given_is_copied():
  recorder = Recorder()
  pos, state, curve = np.zeros(3), np.zeros(2), np.zeros((2, 3))
  recorder.attach("curve", curve)
  recorder.append(0.0, pos, arrays={"state": state})
  pos += 1
  state += 1
  curve += 1
  made = recorder.recording()
  for values in (made.columns["tip_pos"], made.arrays["state"], made.constants["curve"]):
    assert not values.any()


def test_a_strain_given_as_a_function_is_worked_out_once_and_in_time():
  asked = []

  def strain(k):
    return lambda: asked.append(k) or 0.1 * k

  made, plain = Recorder(), Recorder()
  for k in range(4):
    made.append(k, (0, 0, k), strain=strain(k))
    plain.append(k, (0, 0, k), strain=0.1 * k)
    assert asked == list(range(k))
  made.settle()
  made.settle()
  assert asked == list(range(4))
  _same_bits(made.recording().columns["strain"], plain.recording().columns["strain"])


def test_a_number_that_no_sample_has_is_named():
  made = Recorder()
  with pytest.raises(TypeError, match=r"append takes no 'forse', expected some of .*force"):
    made.append(0.0, (0, 0, 0), forse=1.0)
  assert len(made) == 0


def test_missing_samples_are_nan_and_make_the_metric_unknown():
  recorder = Recorder(settings=SETTINGS)
  recorder.append(0.0, [0, 0, 0])
  recorder.append(0.1, [1, 0, 0], force=[0, 0, 2], arrays={"late": [1.0]})
  recorder.append(0.2, [2, 0, 0], force=[0, 0, 1])
  made = recorder.recording()
  assert np.isnan(made.column("force")).tolist() == [[True] * 3, [False] * 3, [False] * 3]
  assert np.isnan(made.arrays["late"])[:, 0].tolist() == [True, False, True]
  assert made.metrics().reasons()["peak_force"] == "force is not finite at sample 0"
  assert made.metrics().path_length == 2
  assert made.column("quat") is None and made.force().tolist()[1:] == [2, 1]


@pytest.mark.parametrize(
  ("kwargs", "match"),
  [
    ({"time": 0.1}, r"sample 2: time is 0.1, expected above 0.1"),
    ({"time": math.nan}, "time is nan"),
    ({"tip_pos": [0, 0]}, r"tip_pos has shape \(2,\), expected \(3,\)"),
    ({"quat": [0, 0, 1]}, r"quat has shape \(3,\), expected \(4,\)"),
    ({"force": [0, 0, 1]}, r"force has shape \(3,\), expected \(\)"),  # began as a magnitude
    ({"visible": [1, 1]}, "visible has shape"),
    ({"arrays": {"q": [1.0, 2.0, 3.0], "n": 1}}, r"'q' is float64 \(3,\), expected float64 \(2,\)"),
    ({"arrays": {"q": [1.0, 2.0]}}, "'n' is int64 and is missing"),
    ({"arrays": {"q": [1.0, 2.0], "n": 1.5}}, "'n' is float64"),
    ({"arrays": {"q": [1.0, 2.0], "n": 1, "a/b": 1.0}}, "array name 'a/b'"),
    ({"arrays": {"q": [1.0, 2.0], "n": 1, "s": "text"}}, "dtype <U4"),
    ({"arrays": {"q": [1.0, 2.0], "n": 1, "late": 3}}, "'late' is int64 and misses"),
    ({"arrays": {"q": [None, {}], "n": 1}}, "dtype object"),
  ],
)
def test_a_refused_sample_leaves_the_recording_as_it_was(tmp_path, kwargs, match):
  recorder = Recorder()
  for k in range(2):
    recorder.append(k * 0.1, [k, 0, 0], force=1.0, arrays={"q": [1.0, 2.0], "n": k})
  before = recorder.recording()
  good = {"time": 0.2, "tip_pos": [2, 0, 0], "force": 2.0, "arrays": {"q": [3.0, 4.0], "n": 2}}
  with pytest.raises(ValueError, match=match):
    recorder.append(**(good | kwargs))
  after = recorder.recording()
  assert len(after.time) == 2
  for table in ("columns", "arrays"):
    assert getattr(after, table).keys() == getattr(before, table).keys()
  recorder.append(**good)
  assert recorder.metrics().path_length == 2
  assert Recording.load(recorder.save(tmp_path / "a.npz")).arrays["n"].tolist() == [0, 1, 2]


def test_two_instruments_need_two_rows():
  recorder = Recorder(("left", "right"))
  with pytest.raises(ValueError, match=r"tip_pos has shape \(3,\), expected \(2, 3\)"):
    recorder.append(0.0, [0, 0, 0])
  recorder.append(0.0, np.zeros((2, 3)), force=[1.0, 2.0])
  assert recorder.metrics().peak_force == 2 and recorder.metrics(0).peak_force == 1
  with pytest.raises(ValueError, match="instrument is 2, expected 0 to 1"):
    recorder.metrics(2)


@pytest.mark.parametrize(
  ("make", "match"),
  [
    (lambda: Recorder([]), "instruments is"),
    (lambda: Recorder("left"), "instruments is"),
    (lambda: Recorder(watch=["fun"]), "no event 'fun' to watch, expected one of target"),
    (lambda: Recorder(info={"x": math.nan}), "info cannot be written as JSON"),
    (lambda: Recorder(info={"x": object()}), "info cannot be written as JSON"),
    (lambda: Recorder().event("fun", 0.0), "no event 'fun', expected one of target"),
    (lambda: Recorder().event("drop", math.nan), "time is nan"),
    (lambda: Recorder().event("target", 0.0, math.inf), "value is inf"),
    (lambda: Recorder().event("drop", 0.0, instrument=1), "instrument is 1 of 1"),
    (lambda: Recorder().attach("curve", [0, 1, 2]), "'curve' has shape"),
    (lambda: Recorder().attach("../x", [0.0]), "constant name"),
    (lambda: Recorder().attach("x", ["a"]), "dtype <U1"),
    (lambda: Settings(force_limit=math.nan), "force_limit is nan"),
    (lambda: Settings(idle_speed=None), "idle_speed is None"),
    (lambda: Settings(contact_force="1"), "contact_force is '1'"),
    (lambda: Settings(local_axis=(0, 0, 0)), "local_axis"),
  ],
)
def test_mistakes_are_named(make, match):
  with pytest.raises(ValueError, match=match):
    make()


def test_docstrings_list_the_fields_in_order():
  for cls in (Recording, Settings, Event):
    lines = [line.strip() for line in cls.__doc__.split("Attributes:")[1].splitlines()]
    fields = [f.name for f in dataclasses.fields(cls)]
    listed = [line.split(":")[0] for line in lines if line.split(":")[0] in fields]
    assert listed == fields
  assert recorder_module.Recording is Recording
