"""Documentation of the state: every field says what it is."""

import dataclasses
import inspect
import re

import pytest
from palpate.engine import workspace
from palpate.tissue import body, config, step, types
from palpate.tissue.geometry import mesh, plate

CLASSES = (
  body.Body, body.Levels, config.Row, mesh.Mesh, plate.Hinges, step.Scheme,
  workspace.Declaration, workspace.Workspace,
)  # fmt: skip
STRUCTS = ("Shape", "Tissue", "State", "System", "Transfer")


@pytest.mark.parametrize("cls", CLASSES, ids=lambda cls: cls.__name__)
def test_every_field_is_documented_in_order(cls):
  told = [base.__doc__ for base in cls.__mro__ if dataclasses.is_dataclass(base)]
  text = "".join(doc.split("Attributes:")[1] for doc in told)
  lines = re.findall(r"^\s{4,6}([a-z][\w, ]*?):", text, re.MULTILINE)
  documented = [name.strip() for line in lines for name in line.split(",")]
  fields = [field.name for field in dataclasses.fields(cls)]
  assert sorted(documented) == sorted(fields)


@pytest.mark.parametrize("name", STRUCTS)
def test_every_field_of_a_struct_says_what_it_is_on_its_line(name):
  text = inspect.getsource(types).split(f"class {name}:")[1].split("\n@struct")[0]
  for field in getattr(types, name).vars:
    line = re.search(rf"(?:^  #.*\n)*^  {field}: .*$", text, re.MULTILINE)[0]
    assert re.search(r"# \w", line) or re.search(r": (vector|scalar)  # ", line), field


def test_a_struct_whose_annotations_are_text_is_refused():
  cls = type("Late", (), {"__annotations__": {"size": "int"}})
  with pytest.raises(TypeError, match="Late: annotations are text"):
    types.struct(cls)
