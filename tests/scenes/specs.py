"""What scenes that are an `mujoco.MjSpec` have in common."""

import mujoco


def servo(spec, joint, gain, damping=0.0):
  """Adds a position actuator, called as its joint; gain [N/m], damping [N s/m]."""
  made = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
  made.set_to_position(gain, kv=damping)
