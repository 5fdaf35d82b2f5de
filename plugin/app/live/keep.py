"""Keeps what a finished exercise hands over, whatever the disk says."""

from __future__ import annotations

import dataclasses
import pathlib
import tempfile
import time

from palpate.tasks.files import free
from palpate.tasks.recording import Recording

from ..trainee.keeping import Sitting


@dataclasses.dataclass
class Finished:
  """What a finished exercise hands over.

  Attributes:
    recording: with actions, metrics and outcome; its `info` has `task`, `task_kwargs`, `seed`,
      `person` (may be empty), `coach` (`assessment`, `hints`) and `live` (`faults`, how punctual)
    path: of its file, None while it could not be kept anywhere
    fault: what went wrong with that, for people; empty where nothing did
    said: what it means for the person, in sentences
  """

  recording: Recording
  path: pathlib.Path | None = None
  fault: str = ""
  said: tuple[str, ...] = ()

  def keep(self, folder: pathlib.Path, record: Sitting | None = None) -> bool:
    """Saves it in a folder, or else among the temporary files; returns whether it is in a file.

    It may be called again: what is in the folder stays as it is.

    Args:
      folder: of recordings whose person is not known
      record: of people, None without one
    """
    if self.path is not None and not self.fault:
      return True
    person = str(self.recording.info.get("person", ""))
    if record is not None and record.keeping.knows(person):
      kept = record.keep(self.recording, person)
      self.path, self.fault, self.said = kept.path or self.path, kept.fault, kept.said
      return self.path is not None
    task = str(self.recording.info.get("task", "exercise")).replace("/", "_")
    name = f"{time.strftime('%Y%m%d-%H%M%S')}_{task}"
    try:
      folder.mkdir(parents=True, exist_ok=True)
      self.path, self.fault = self.recording.save(free(folder, name, ".npz")), ""
      return True
    except OSError as error:
      self.fault = f"not kept in {folder}: {error.strerror or error}"
    if self.path is None:
      try:
        beside = pathlib.Path(tempfile.mkdtemp(prefix="palpate-"))
        self.path = self.recording.save(free(beside, name, ".npz"))
      except OSError as error:
        self.fault += f"; nor among the temporary files: {error.strerror or error}"
    return self.path is not None
