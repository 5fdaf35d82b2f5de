"""MJCF of organs, tools and worlds: the one place where tests and benches declare them."""

import numpy as np
from palpate.models import mjcf

from .surfaces import RADIUS, sphere

FLEX = 0.0005  # radius of the flexes [m]
PLAIN = {"solref": "0.004 1", "condim": "1"}  # stiff contacts without friction
# Of a rigid organ: its windows have the contacts.
NO_CONTACT = {"contype": 0, "conaffinity": 0, "selfcollide": "none"}
DIGITS = 17  # of numbers in MJCF: all that a double has


def plugin(**config):
  """Returns the plugin's declaration; a key of None is left out, `device` is cpu unless given."""
  return mjcf.plugin(_keys(config), digits=DIGITS)


def _keys(config):
  return {k: v for k, v in ({"device": "cpu"} | config).items() if v is not None}


def contacts(contact):
  """Returns how a flex touches: stiff and without friction unless said otherwise."""
  return {"selfcollide": "none"} | PLAIN | (contact or {})


def flex(points, elem, inside, name="organ", pin=(), contact=None, **attributes):
  """Returns a flexcomp whose nodes are MuJoCo's, around what is `inside` of it."""
  attributes = {"mass": 0.1, "radius": FLEX} | attributes
  attributes |= {"inside": inside, "contact": contacts(contact), "pin": pin, "digits": DIGITS}
  return mjcf.flexcomp(name, (points, elem), **attributes)


def organ(
  points, elem, name="organ", mass=0.1, pin=(), contact=None, radius=FLEX, rgba=None, **config
):
  """Returns an organ whose nodes are MuJoCo's; `config` are the plugin's keys."""
  inside = "\n".join([plugin(**config), mjcf.EDGE])
  return flex(points, elem, inside, name, pin, contact, mass=mass, radius=radius, rgba=rgba)


def windowed(
  points, elem, name="organ", grid="window", count="9 6 1", contact=None, radius=FLEX, **config
):
  """Returns an organ in a body of its own and the flexcomp of its window, `count` slots."""
  keys = plugin(**{"window": grid, "mass": 0.1} | config)
  surface = mjcf.flexcomp(
    name, (points, elem), contact=NO_CONTACT, digits=DIGITS, rigid=True, radius=radius
  )
  window = mjcf.flexcomp(
    grid, inside=mjcf.EDGE, contact=contacts(contact), type="grid", count=count,
    spacing=".01 .01 .01", mass=0.01, radius=radius,
  )  # fmt: skip
  return mjcf.tag("body", {"name": name}, f"{keys}\n{surface}") + window


def world(
  *bodies,
  h=1e-3,
  gravity=(0, 0, 0),
  integrator="Euler",
  solver="Newton",
  tolerance=1e-10,
  memory=100,
  option="",
  flag="",
  extra="",
):
  """Returns a whole MJCF document around the bodies; `memory` in MB."""
  return (
    f'<mujoco><option timestep="{h}" gravity="{mjcf.numbers(gravity)}" integrator="{integrator}" '
    f'solver="{solver}" tolerance="{tolerance}" {option}>{flag}</option><size memory="{memory}M"/>'
    f"{mjcf.extension()}"
    f"<worldbody>{''.join(bodies)}</worldbody>{extra}</mujoco>"
  )


def ball(z, radius=0.006, mass=0.05, joint=True):
  """Returns a ball on a vertical slide called `z`, at height z."""
  slide = '<joint name="z" type="slide" axis="0 0 1"/>' if joint else ""
  return (
    f'<body name="ball" pos="0 0 {z}">{slide}'
    f'<geom size="{radius}" mass="{mass}" condim="1" solref="0.004 1"/></body>'
  )


def press(h=1e-3, subdivisions=2, integrator="Euler", frame=(), tool=0.006, **config):
  """Returns a sphere on a foundation with a driven ball above; `ctrl` is its depth."""
  config = {"young": 30e3, "foundation": 2e5} | config
  points, elem = sphere(subdivisions)
  inside = organ(points, elem, **config) + ball(RADIUS + tool + 0.0005, tool)
  for attributes in reversed(frame):
    inside = f"<body {attributes}>{inside}</body>"
  drive = '<actuator><position name="depth" joint="z" kp="500" kv="10"/></actuator>'
  return world(inside, h=h, integrator=integrator, extra=drive)


PROBED = {"young": 3e4, "poisson": 0.3, "foundation": 1e4, "tolerance": 1e-6}


def probed(
  window=True, *, keys=None, count="9 6 1", frame="", condim=3, h=1e-3, cone="pyramidal", flag=""
):
  """Returns a sphere under a probe on two slides; with a window, or with all nodes MuJoCo's."""
  points, elem = sphere(2)
  contact = {"condim": condim, "friction": "0.5", "solref": "0.004 1"}
  keys = PROBED | (keys or {})
  if window:
    made = windowed(points, elem, count=count, contact=contact, **keys)
  else:
    made = organ(points, elem, contact=contact, **keys)
  tool = f"""<body name="tool" pos="0.0013 0.0007 {RADIUS + 0.0067}">
    <joint name="z" type="slide" axis="0 0 1"/><joint name="x" type="slide" axis="1 0 0"/>
    <geom name="tip" size="0.006" mass="0.05" condim="{condim}" friction="0.5"/></body>"""
  drive = """<actuator><position joint="z" kp="500" kv="10"/>
    <position joint="x" kp="500" kv="10"/></actuator>"""
  body = f'<body name="frame" {frame}>{made}{tool}</body>'
  return world(body, h=h, option=f'cone="{cone}"', flag=flag, extra=drive)


def ridge(frame="", pinned=True, contact=None, extra=""):
  """Returns a ridge of tissue between the jaws of a grasper that also lifts."""
  points, elem = sphere(2, 1.0)
  points = points * [0.010, 0.02, 0.03]
  pin = np.flatnonzero(points[:, 2] < -0.02) if pinned else ()
  contact = {"condim": 4, "friction": 1} | (contact or {})
  keys = {"young": 2e4, "bulk": 1e4, "foundation": 1e4, "tolerance": 1e-7}
  colour = (0.8, 0.4, 0.3, 1)
  tissue = organ(points, elem, mass=0.02, pin=pin, contact=contact, rgba=colour, **keys)
  jaws = "".join(
    f'<body name="{name}" pos="{0.0165 * side} 0 0">'
    f'<joint name="{name}" type="slide" axis="{-side} 0 0"/><geom name="{name}" type="ellipsoid" '
    f'size="0.004 0.008 0.006" mass="0.01" friction="1" condim="4"/></body>'
    for name, side in (("left", 1), ("right", -1))
  )
  grasper = f"""<body name="grasper" pos="0 0 0.022"><joint name="z" type="slide" axis="0 0 1"/>
    <geom size="0.002" pos="0 0 0.03" mass="0.05" contype="0" conaffinity="0"/>{jaws}</body>"""
  drive = """<actuator><position joint="z" kp="1000" kv="20"/>
    <position joint="left" kp="300" kv="5"/><position joint="right" kp="300" kv="5"/></actuator>"""
  body = f'<body name="frame" {frame}>{tissue}{grasper}</body>'
  return world(body, extra, integrator="implicitfast", option='cone="elliptic"', extra=drive)
