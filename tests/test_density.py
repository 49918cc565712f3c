"""How dense the code is, and how often it says why."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).resolve().parent.parent / "tools"))

from density import by_room, density

ROOMS = by_room()
MOST_NODES = 12  # of a line, in the median: what can be read at a glance
COMMENTS = (3, 9)  # lines in a hundred; more would say what the code says
EXPLAINED = ("core", "images", "loops", "uncertainty")


def test_a_file_is_counted_as_it_is_described():
    found = density(
        '''"""About the file."""

# why
def double(x):
    """Twice."""
    y = 2 * x  # exact

    return (
        y
    )
'''
    )
    # y = 2 * x: assignment, name, product, 2, x; return on one line, y on the next, which is a line of its own
    assert found == ((5, 1, 1), 2, 8)


@pytest.mark.parametrize("room", ROOMS)
def test_lines_can_be_read_at_a_glance(room):
    assert ROOMS[room].nodes_a_line <= MOST_NODES


@pytest.mark.parametrize("room", EXPLAINED)
def test_reasons_are_told(room):
    least, most = COMMENTS
    assert least <= ROOMS[room].comments_in_100 <= most


def test_comments_do_not_outgrow_the_code():
    assert ROOMS["src"].comments_in_100 <= COMMENTS[1]
