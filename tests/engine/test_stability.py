"""The implicit step under stress: thick, stiff, light shells from crushed and torn shapes."""

import mujoco
import numpy as np
import pytest
from palpate.tissue import energy
from palpate.tissue import step as stepping

MASS = 0.005  # of the shell [kg]


def _start(points, name):
  if name == "crushed":
    return points * [0, 0, -0.9]
  edge = 0.0075  # of the sphere with 642 nodes [m]
  return 0.4 * edge * np.random.RandomState(1).standard_normal(points.shape)


@pytest.mark.parametrize("h", [1e-3, 5e-3])
@pytest.mark.parametrize("start", ["crushed", "scattered"])
def test_a_thick_shell_gains_no_energy_and_comes_to_rest(scenes, start, h):
  # 10 mm thick at 50 mm radius: bending outweighs the membrane. With the matrix along the nodes'
  # normals alone the energy grew 20 to 3000 times.
  points, elem = scenes.sphere(3)
  config = {"young": (1e6,), "thickness": 0.01, "bend": 1.0, "damping": 2e-4, "poisson": 0.3}
  mesh, settings, body = scenes.kernels(points, elem, foundation=2e6, **config)
  mass = MASS / mesh.nvert
  row = [[h, h * h + h * settings.damping, MASS * (9.81 * stepping.REST * h) ** 2, 0]]
  body.state.step.assign(np.array(row, np.float32))
  scenes.put(body, body.state.mass, np.array(mass))
  u, v = _start(points, start), np.zeros_like(points)
  energies = [energy.total(mesh, settings, u)]
  for n in range(60):
    for array, values in ((body.state.disp, u), (body.state.vel, v)):
      scenes.put(body, array, values)
    stepping.step(body)
    v += scenes.get(body, body.state.dvel)
    u += h * v
    if n % 5 == 4:
      energies.append(energy.total(mesh, settings, u) + 0.5 * mass * (v * v).sum())
  assert max(energies) < 1.05 * energies[0]
  assert energies[-1] < 0.05 * energies[0]


@pytest.mark.parametrize("h", [1e-3, 5e-3])
def test_the_stabilising_stiffness_acts_on_the_change_of_velocity_only(scenes, h):
  # A free thick shell spins on: K v of a rotation is zero, and the added stiffness not in it.
  points, elem = scenes.sphere(2)
  config = {"young": (1e5,), "thickness": 0.01, "bend": 1.0, "damping": 0.01}
  _, _, body = scenes.kernels(points, elem, **config)
  v = np.cross([0, 0, 0.1], points)  # slow: no stretch to speak of
  found = scenes.step(body, h, np.zeros_like(points), v, 1e-4)
  assert np.abs(found).max() < 1e-3 * np.abs(v).max()


@pytest.mark.parametrize("windowed", [False, True], ids=["nodal", "window"])
@pytest.mark.parametrize("young", [8e3, 3e5])
def test_jaws_that_pierce_an_organ_give_it_no_more_energy_than_their_work(scenes, windowed, young):
  points, elem = scenes.sphere(2)
  z = points[:, 2].max() - 0.001
  jaws = "".join(
    f"""<body pos="{x} 0 {z}"><joint name="{name}" type="slide" axis="{sign} 0 0" damping="0.5"
      limited="true" range="-0.01 0.0138"/><joint name="{name}_z" type="slide" axis="0 0 1"/>
      <geom type="capsule" euler="90 0 0" size="0.002 0.01" mass="0.05" condim="4"/></body>"""
    for name, x, sign in (("left", -0.014, 1), ("right", 0.014, -1))
  )
  build = scenes.windowed if windowed else scenes.organ
  made = build(points, elem, contact={"condim": 4}, young=young, foundation=1e4)
  model, data, organ = scenes.load(scenes.world(made, jaws))
  shut, down = (
    [model.joint(name + way).dofadr[0] for name in ("left", "right")] for way in ("", "_z")
  )
  moving, work, had, pierced = shut + down, 0.0, 0.0, False
  for _ in range(250):
    data.qfrc_applied[shut] = 16.0 * min(1, data.time / 0.05)  # [N]
    data.qfrc_applied[down] = -200 * 0.004 * min(1, data.time / 0.05) - 2 * data.qvel[down]
    mujoco.mj_step(model, data)
    work += model.opt.timestep * float(data.qfrc_applied[moving] @ data.qvel[moving])
    energy = organ.energy
    assert energy - had < 0.01
    assert energy + 0.5 * 0.05 * (data.qvel[moving] ** 2).sum() < 1.01 * work + 1e-4
    had, pierced = energy, pierced or bool(organ.pierced)
  assert organ.error is None and pierced
