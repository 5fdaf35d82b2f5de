"""Docstrings of the state classes against their fields."""

import dataclasses
import re

import pytest
from palpate.engine import workspace
from palpate.tissue import config, mesh, types

CLASSES = (
  config.Config,
  mesh.Mesh,
  mesh.Hinges,
  types.Surface,
  types.State,
  workspace.Declaration,
  workspace.Workspace,
)


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_field_is_documented_in_order(cls):
  text = cls.__doc__.split("Attributes:")[1]
  lines = re.findall(r"^\s{4,6}([a-z][\w, ]*?):", text, re.MULTILINE)
  documented = [name.strip() for line in lines for name in line.split(",")]
  fields = [field.name for field in dataclasses.fields(cls)]
  assert sorted(documented) == sorted(fields)
