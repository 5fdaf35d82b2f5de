"""Several mjData of one model with cuts, in threads and after mj_setConst."""

import copy
import pickle
import threading

import mujoco
import numpy as np
import palpate
import pytest
import scenes


def scene(windows=False, **keys):
  """Returns a model of a ball that falls on a sphere with room for cuts."""
  spec = mujoco.MjSpec()
  spec.option.timestep = 2e-3
  body = spec.worldbody.add_body(name="ball", pos=[0, 0, scenes.RADIUS + 0.0105])
  body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], damping=[1, 0, 0], name="z")
  body.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=0.02)
  given = {"mass": 0.3, "young": 5e3, "foundation": 4e4, "spare": 200, "device": "cpu"} | keys
  palpate.add_organ(spec, scenes.sphere(2), "organ", windows=windows, **given)
  return spec.compile()


def arc(angle):
  """Returns a path over the top of the sphere."""
  t = np.linspace(-0.6, 0.6, 20)
  way = [np.sin(t) * np.cos(angle), np.sin(t) * np.sin(angle), np.cos(t)]
  return scenes.RADIUS * np.stack(way, axis=1)


def test_threads_that_cut_and_step_one_nodal_model_do_not_disturb_each_other():
  model, count = scene(), 6

  def go(model, k, out):
    data = mujoco.MjData(model)
    organ = palpate.Organ(model, data, "organ")
    for step in range(150):
      mujoco.mj_step(model, data)
      if step == 20 + 20 * k:
        organ.cut(arc(0.7 * k))
    out[k] = organ.xpos, data.qpos[0]

  alone: dict = {}
  for k in range(count):
    go(copy.copy(model), k, alone)
  for _ in range(3):  # a race
    found: dict = {}
    threads = [threading.Thread(target=go, args=(model, k, found)) for k in range(count)]
    for thread in threads:
      thread.start()
    for thread in threads:
      thread.join()
    for k in range(count):
      np.testing.assert_array_equal(found[k][0], alone[k][0])
      assert found[k][1] == alone[k][1]


@pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])
def test_no_thread_changes_triangles_that_another_may_be_reading(windows):
  model = scene(windows)

  def go(model, angle):
    data = mujoco.MjData(model)
    mujoco.mj_step(model, data, 40)
    palpate.Organ(model, data, "organ").cut(arc(angle))
    mujoco.mj_step(model, data, 40)
    datas.append(data)
    return data

  datas: list = []
  whole = model.flex_elem.copy()
  go(model, 0.0)
  one = model.flex_elem.copy()
  assert (one != whole).any()
  thread = threading.Thread(target=go, args=(model, 0.7))
  thread.start()
  thread.join()
  np.testing.assert_array_equal(model.flex_elem, one)
  alone = go(copy.copy(model), 0.7)
  np.testing.assert_array_equal(datas[1].qpos, alone.qpos)
  assert datas[1].ncon == alone.ncon > 0
  np.testing.assert_array_equal(datas[1].contact.elem, alone.contact.elem)


@pytest.mark.parametrize("elements", ["membrane", "solid"])
@pytest.mark.parametrize("windows", [False, True], ids=["nodal", "windows"])
def test_set_const_leaves_a_cut_model_what_it_was(windows, elements):
  model = scene(windows, elements=elements)
  data = mujoco.MjData(model)
  organ = palpate.Organ(model, data, "organ")
  organ.cut(arc(0.3))
  mujoco.mj_step(model, data, 5)
  model.body("ball").mass *= 1.1
  mujoco.mj_setConst(model, data)
  mujoco.mj_resetData(model, data)
  organ.cut(arc(0.3))
  mujoco.mj_step(model, data, 5)
  fresh = mujoco.MjData(model)
  whole = palpate.Organ(model, fresh, "organ")
  mujoco.mj_step(model, fresh, 5)
  assert whole.nvert == len(scenes.sphere(2)[0]) and whole.error is None
  sent = pickle.loads(pickle.dumps(data))
  again = palpate.Organ(sent.model, sent, "organ")
  for each in (data, sent):
    mujoco.mj_step(each.model, each, 5)
  assert again.nvert == organ.nvert > whole.nvert and again.error is None and organ.error is None
  np.testing.assert_array_equal(again.xpos, organ.xpos)
