"""Files with bytes, lines and arrays changed: a ValueError with words, or what they hold."""

from __future__ import annotations

import functools
import io
import json
import pathlib
import tempfile

import numpy as np
import scenes
import trimesh
from palpate.models.meshing import volume, wrap
from palpate.tasks.recorder import Recorder
from palpate.tasks.recording import Recording

KEPT: tuple[int, ...] = ()  # seeds that once failed
# Seeds that fail, and why.
OPEN: dict[int, str] = {}


NODES = 100
VOXEL = 3.0  # of the label map [mm]


@functools.cache
def _ball(kind: str) -> bytes:
  """Returns a small sphere as a file."""
  mesh = trimesh.Trimesh(*scenes.sphere(1), process=False)
  data = mesh.export(file_type=kind)
  return data if isinstance(data, bytes) else data.encode()


@functools.cache
def _labels(kind: str) -> bytes:
  """Returns a small label map as a file."""
  grid = np.indices((14, 14, 14)) - 6.5
  map_ = ((grid**2).sum(axis=0) < 30).astype(np.uint8)
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / f"ball{kind}"
    if kind == ".nrrd":
      import nrrd

      space = {"space directions": VOXEL * np.eye(3), "space": "left-posterior-superior"}
      nrrd.write(str(path), map_, space)
    else:
      import nibabel

      nibabel.save(nibabel.Nifti1Image(map_, np.diag([VOXEL, VOXEL, VOXEL, 1])), path)
    return path.read_bytes()


@functools.cache
def _recording() -> bytes:
  """Returns a short recording as a file."""
  recorder = Recorder(["tip"])
  for k in range(12):
    recorder.append(0.02 * k, [0.001 * k, 0, 0], force=[0, 0, 0.1 * k], visible=True)
  with tempfile.TemporaryDirectory() as folder:
    return recorder.save(pathlib.Path(folder) / "a.npz").read_bytes()


def spoil(random, data: bytes) -> bytes:
  """Returns the bytes cut, changed, repeated or with numbers replaced."""
  kind, at = random.randint(6), random.randint(len(data) + 1)
  if kind == 0:
    return data[:at]
  if kind == 1:
    out = bytearray(data)
    for _ in range(random.randint(1, 20)):
      out[random.randint(len(out))] = random.randint(256)
    return bytes(out)
  if kind == 2:
    return data[:at] + random.bytes(random.randint(1, 64)) + data[at:]
  if kind == 3:
    lines = data.split(b"\n")
    i, j = random.randint(0, len(lines), 2)
    lines[i], lines[j] = lines[j], lines[i] * random.randint(3)
    return b"\n".join(lines)
  if kind == 4:
    words = data.split(b" ")
    odd = (b"nan", b"-1", b"1e400", b"0", b"999999999", b"x", b"", b"1/1/1")
    for _ in range(random.randint(1, 6)):
      words[random.randint(len(words))] = odd[random.randint(len(odd))]
    return b" ".join(words)
  return data


def _spoil_arrays(random, data: bytes) -> bytes:
  """Returns a recording with one of its arrays changed."""
  with np.load(io.BytesIO(data)) as archive:
    arrays = {name: archive[name] for name in archive.files}
  name = sorted(arrays)[random.randint(len(arrays))]
  array, kind = arrays[name], random.randint(6)
  if kind == 0:
    del arrays[name]
  elif kind == 1:
    arrays[name] = array[..., None]
  elif kind == 2:
    arrays[name] = array[:-1] if array.ndim else np.zeros(3)
  elif kind == 3 and array.dtype.kind == "f" and array.size:
    array = array.copy()
    array.flat[random.randint(array.size)] = random.choice([np.nan, np.inf, -1e300])
    arrays[name] = array
  elif kind == 4:
    arrays[name] = np.array("{" * random.randint(1, 5))
  else:
    meta = json.loads(str(arrays["meta"]))
    key = sorted(meta)[random.randint(len(meta))]
    meta[key] = random.choice([None, "x", -1], 1).tolist()[0]
    arrays["meta"] = np.array(json.dumps(meta))
  out = io.BytesIO()
  np.savez(out, **arrays)
  return out.getvalue()


MESHES = ("obj", "stl", "ply", "glb")
VOLUMES = (".nii", ".nrrd")


def check(seed: int):
  """Checks the file of a seed."""
  random = np.random.RandomState(seed)
  kind = random.choice([*MESHES, *VOLUMES, "npz", "npz"])
  sound = _ball(kind) if kind in MESHES else _labels(kind) if kind in VOLUMES else _recording()
  change = _spoil_arrays if kind == "npz" and random.randint(2) else spoil
  data = change(random, sound)
  with tempfile.TemporaryDirectory() as folder:
    path = pathlib.Path(folder) / f"ball.{kind.lstrip('.')}"
    path.write_bytes(data)
    if kind in MESHES:
      method, nodes = [("direct", None), ("even", NODES)][random.randint(2)]
      read = functools.partial(wrap.wrap, path, nodes, method=method)
    elif kind in VOLUMES:
      read = functools.partial(volume.wrap_volume, path, NODES)
    else:
      read = functools.partial(_measure, path)
    try:
      with np.errstate(all="ignore"):
        made = read()
    except ValueError as error:
      assert data != sound, f"a sound file is refused: {error}"
      assert str(error).strip(), "an error without words"
      return
  if kind != "npz":
    vertices, triangles, _ = made
    assert np.isfinite(vertices).all() and triangles.min() >= 0 and triangles.max() < len(vertices)


def _measure(path: pathlib.Path):
  """Reads a recording and its metrics."""
  return Recording.load(path).metrics()
