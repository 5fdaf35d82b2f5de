"""The tables of what an organ keeps and exchanges."""

import itertools

import mujoco
import palpate
import pytest
from palpate.engine import coupling, layout
from scenes import probed

SIZES = {"nfree": 21, "ninner": 6, "nmoving": 27}
SIZES |= {"nvert": 9, "nslot": 5, "ngeom": 3, "most": 7}
SIZES |= {"nrelax": 4, "nrest": 6, "nbond": 3, "nblade": 2, "nneedle": 2}
SIZES |= {"ncorner": 8, "nplace": 10, "nspare": 2, "ncuts": 1}
BLOCKS = (layout.NodalState, layout.WindowState, layout.Inbox, layout.Outbox)


@pytest.mark.parametrize("kind", BLOCKS, ids=lambda kind: kind.key)
def test_blocks_follow_one_another(kind):
  where = list(layout.spans(kind, SIZES).values())
  assert where[0].start == 0 and where[-1].stop == layout.size(kind, SIZES)
  assert all(a.stop == b.start for a, b in itertools.pairwise(where))


@pytest.mark.parametrize("table", layout.TABLES, ids=lambda table: table.rows[0][0])
def test_numbers_have_a_name_a_unit_and_a_meaning(table):
  names = [name for name, *_ in table.rows]
  assert len(set(names)) == len(names) and all(all(row) for row in table.rows)
  assert [getattr(table, name) for name in names] == sorted(getattr(table, name) for name in names)
  assert len(table) == sum(size for _, size, *_ in table.rows)
  with pytest.raises(AttributeError, match="'nonsense'"):
    table.nonsense  # noqa: B018


@pytest.mark.parametrize("window", [True, False])
def test_the_plugin_state_has_room_for_its_table(window):
  m = mujoco.MjModel.from_xml_string(probed(window=window))
  organ = palpate.Organ(m, mujoco.MjData(m), "organ")
  sizes = coupling.nodal_sizes(3 * organ.nvert, 0)
  sizes |= {"nvert": organ.nvert, "nslot": 54, "ngeom": 1}
  sizes |= layout.NO_CUTS | {"nrelax": 0, "nrest": 0, "nbond": 0}
  needed = layout.size(layout.WindowState if window else layout.NodalState, sizes)
  # It is asked for before the windows are known.
  assert m.npluginstate >= needed if window else m.npluginstate == needed
