"""Names of test files, and the selection of tests that run without --all-sets."""

from pathlib import Path

import pytest
from helpers.launch import PARTS, refuse_repeated_names, thinned


def test_files_of_one_name_are_refused(tmp_path):
    tests = tmp_path / "tests"
    for folder in ("contact", "statics"):
        (tests / folder).mkdir(parents=True)
        (tests / folder / "conftest.py").touch()
        (tests / folder / f"test_{folder}.py").touch()
    refuse_repeated_names(tests)
    (tests / "statics" / "test_contact.py").touch()
    with pytest.raises(pytest.UsageError) as caught:
        refuse_repeated_names(tests)
    assert "tests/contact/test_contact.py and tests/statics/test_contact.py\n" in str(caught.value)
    assert "rename all but one" in str(caught.value)


class Item:
    """What the selection asks of a test."""

    path = Path("test_it.py")
    name = originalname = "test_it"

    def __init__(self, number, *marks):
        self.number, self.marks = number, marks

    def get_closest_marker(self, name):
        return name if name in self.marks else None


def test_sets_and_parts_that_run():
    for marks, ranks, kept in (
        ((), 1, [0, 10, 20, 30, 40]),
        (("slow",), 1, [0, 10, 20, 30, 40]),
        (("few_sets",), 1, [0, 40]),
        (("few_sets", "slow"), 2, [1, 33]),
        (("slow",), 2, [1, 9, 17, 25, 33, 41]),
        (("thorough",), 1, []),
    ):
        items = [Item(number, *marks) for number in range(42)]
        parts = [[item.number for item in thinned(items, ranks, part)] for part in range(PARTS)]
        # a slow test is in one of the parts, others are in all
        assert sorted(parts) == (PARTS * [kept] if "slow" not in marks else [*(PARTS - 1) * [[]], kept])
