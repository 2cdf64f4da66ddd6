"""Refusals by their codes: one class for each family, for programs that get them from elsewhere too."""

import re
from pathlib import Path

import pytest

from zbridge.errors import Code, Held, LeaseLost, Refused, Unsupported, refusal

PAGE = (Path(__file__).parents[1] / "docs" / "reference" / "refusals.md").read_text()


@pytest.mark.parametrize("code", Code)
def test_every_code_has_one_class_and_comes_back_with_it(code: Code) -> None:
    raised = refusal(code, "because")
    assert (raised.code, str(raised)) == (code, "because")
    assert [family for family in Refused.__subclasses__() if code in family.codes] == [type(raised)]


def test_a_code_of_tomorrow_is_unsupported_and_a_class_alone_has_the_usual_code_of_its_family() -> None:
    raised = refusal("too_late", "because", holder="ann")
    assert (type(raised), raised.code, raised.holder) == (Unsupported, Code.UNSUPPORTED, "ann")
    assert [family("x").code for family in (Held, LeaseLost)] == ["held", "lease_ended"]


def test_the_page_names_every_code_with_its_class() -> None:
    rows = re.findall(r"^\| ((?:`\w+`(?:, )?)+) \| `(\w+)`", PAGE, re.MULTILINE)
    told = {code: family for codes, family in rows for code in re.findall(r"\w+", codes)}
    assert told == {str(code): type(refusal(code, "")).__name__ for code in Code}
