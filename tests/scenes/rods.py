"""Threads of 0.2 mm as MJCF: alone, around a drum, over an organ, with a needle, in jaws."""

import mujoco
import numpy as np
import palpate
import trimesh

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
  mujoco.mj_step(model, data, steps)


def force(model, data, node, value):
  adr = model.body(f"t_{node}").dofadr[0]
  data.qfrc_applied[adr : adr + 3] = value


FREE = 'gravity="0 0 0"'


def drum(friction, cone, kind="cylinder", h=1e-3, radius=0.01):
  """Returns a thread half around a drum, its left end to be loaded, its right end on a slide."""
  tail, n = 3 * radius, 81
  r = radius + RADIUS
  s = np.linspace(0, np.pi * r + 2 * tail, n)
  angle = np.clip(np.pi - (s - tail) / r, 0, np.pi)
  below = np.maximum(tail - s, 0) + np.maximum(s - tail - np.pi * r, 0)
  points = np.stack([r * np.cos(angle), 0 * s, r * np.sin(angle) - below], axis=1)
  x, _, z = points[-1]
  world = f"""<geom type="{kind}" size="{radius} .02" euler="90 0 0" friction="{friction} 0 0"/>
    <body name="puller" pos="{x} 0 {z}"><joint name="pull" type="slide" axis="0 0 -1"/>
    <geom size=".002" mass=".1" contype="0" conaffinity="0"/></body>"""
  after = f"""<equality><connect body1="puller" body2="t_{n - 1}" anchor="0 0 0" solref=".002 1"/>
    </equality><actuator><velocity joint="pull" kv="100"/></actuator>"""
  contact = f'friction="{friction} 0 0" condim="3"'
  option = f'cone="{cone}" {FREE}'
  keys = dict(world=world, after=after, contact=contact, option=option, bend=0.01, h=h)
  return document(points, **keys)


def needle(mass, n=41):
  """Returns a needle on the end of a thread, beside the point that it hangs on."""
  world = f"""<body name="needle" pos=".08 0 0"><freejoint/><geom type="capsule" size=".0004"
    fromto="0 0 0 .012 0 0" mass="{mass}" contype="0" conaffinity="0"/></body>"""
  after = f"""<equality><connect body1="needle" body2="t_{n - 1}" anchor="0 0 0" solref=".002 1"/>
    </equality>"""
  return document(line(n, 0.08), pin=(0,), world=world, after=after, bend=0.02)


def hand(n=41, held=True):
  """Returns jaws that close on a thread in the middle, where an equality `grip` holds it or may."""
  jaws = "".join(
    f"""<body pos="0 0 {-way * 0.0014}"><joint name="jaw{k}" type="slide" axis="0 0 {way}"
      damping="2"/><geom type="box" size="0.002 0.002 0.001" mass="0.02" friction="0.2"
      solref="0.002 1"/></body>"""
    for k, way in enumerate((-1, 1))
  )
  world = f"""<body name="hand" pos="0.01 0 0"><joint name="hand" type="slide" axis="0 1 0"
    damping="5"/><geom size="0.001" mass="0.2" contype="0" conaffinity="0"/>{jaws}</body>"""
  motors = "".join(f'<motor joint="{name}"/>' for name in ("hand", "jaw0", "jaw1"))
  ties = f"""<equality><connect name="grip" body1="hand" body2="t_{n // 2}" anchor="0 0 0"
    solref="0.002 1" active="{str(held).lower()}"/></equality>"""
  option = f'{FREE} cone="elliptic" impratio="10"'
  after = f"<actuator>{motors}</actuator>{ties}"
  return document(line(n, 0.02), option=option, world=world, after=after, bend=0.02)


def shake(k):
  """Returns the forces on a hand and its jaws in a step: 15 g there and back, and a grip of 5 N."""
  return 30.0 * np.sign(np.sin(2 * np.pi * k / 50)), 5.0, 5.0


def draped(first="ball", nodes=None):
  """Returns a thread over a soft ball, its ends hanging, and which of them comes first."""
  spec = mujoco.MjSpec()
  ball, r = trimesh.creation.icosphere(subdivisions=2, radius=0.03), 0.0313
  low = np.flatnonzero(ball.vertices[:, 2] < -0.015)
  mesh = np.array(ball.vertices), np.array(ball.faces)
  s = np.linspace(-0.07, 0.07, 57)
  angle = np.clip(s / r, -np.pi / 2, np.pi / 2)
  below = np.abs(s - r * angle)
  points = np.stack([r * np.sin(angle), 0 * s, r * np.cos(angle) - below], axis=1)
  for name in dict.fromkeys((first, "ball", "t")):
    if name == "t":
      palpate.add_thread(spec, points, "t")
    else:
      palpate.add_organ(spec, mesh, "ball", young=1.5e4, elements="solid", pin=low)
  if nodes:
    palpate.add_windows(spec, "ball", nodes=nodes)
  return spec
