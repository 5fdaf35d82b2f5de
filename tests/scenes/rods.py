"""A thread of 0.2 mm as MJCF, in a scene of a test's own."""

import mujoco
import numpy as np
import palpate

RADIUS, YOUNG, POISSON, MASS = 1e-4, 5e9, 0.3, 8e-6
AREA = np.pi * RADIUS**2  # [m^2]
STRETCH = YOUNG * AREA  # E A [N]
BENDING = YOUNG * np.pi * RADIUS**4 / 4  # E I [N m^2]


def line(n, length, start=0.0):
  points = np.zeros((n, 3))
  points[:, 0] = start + np.linspace(0, length, n)
  return points


def document(points, *, pin=(), h=1e-3, world="", after="", option="", contact="", flex="", **keys):
  """Returns MJCF with a thread `t`."""
  config = {"elements": "rod", "young": YOUNG, "poisson": POISSON} | keys
  config = "".join(f'<config key="{key}" value="{value}"/>' for key, value in config.items())
  pins = f'<pin id="{" ".join(map(str, pin))}"/>' if len(pin) else ""
  elem = " ".join(f"{i} {i + 1}" for i in range(len(points) - 1))
  return f"""<mujoco><option timestep="{h}" {option}/>
    <extension><plugin plugin="palpate.organ"/></extension><worldbody>{world}
    <flexcomp name="t" type="direct" dim="1" radius="{RADIUS}" mass="{MASS}" {flex}
      point="{" ".join(map(repr, np.ravel(points).tolist()))}" element="{elem}">
    <plugin plugin="palpate.organ">{config}</plugin><edge damping="1e-9"/>{pins}
    <contact selfcollide="none" solref="0.004 1" solmix="1000" {contact}/></flexcomp>
    </worldbody>{after}</mujoco>"""


def loaded(text):
  model = mujoco.MjModel.from_xml_string(text)
  data = mujoco.MjData(model)
  return model, data, palpate.Thread(model, data, "t")


def load(*args, **kwargs):
  return loaded(document(*args, **kwargs))


def run(model, data, steps):
  for _ in range(steps):
    mujoco.mj_step(model, data)


def force(model, data, node, value):
  adr = model.body(f"t_{node}").dofadr[0]
  data.qfrc_applied[adr : adr + 3] = value


FREE = 'gravity="0 0 0"'
