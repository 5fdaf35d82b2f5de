# lerobot needs Python 3.12, so types are checked without it:
# pyright: reportMissingImports=false
"""What LeRobot's environment hub takes: upload this file as a repository's `env.py`.

from lerobot.envs.factory import make_env
envs = make_env("USER/REPOSITORY", n_envs=4, trust_remote_code=True)
"""

from typing import Any

from lerobot.envs import factory
from palpate.tasks.lerobot import Palpate


def make_env(n_envs: int = 1, use_async_envs: bool = False, cfg: Any = None) -> dict[str, Any]:
  """Returns the exercise of a `Palpate`, touch/easy without one, n_envs of it as a vector."""
  return factory.make_env(cfg or Palpate(), n_envs, use_async_envs)
