"""Version lists and the highest common version."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from zbridge.protocol.handshake import agree, parse_versions


@pytest.mark.parametrize(
    ("listed", "versions"),
    [
        (" 1.1 , 1.2,10.20.30", ("1.1", "1.2", "10.20.30")),
        ("1.1,beta,1.x,1.,.1,-1,1.3", ("1.1", "1.3")),
        *((nothing, ()) for nothing in ("", ",,", "1234567890.1", "1.1;1.2")),
    ],
)
def test_a_version_list_yields_its_dotted_numbers(listed: str, versions: tuple[str, ...]) -> None:
    assert parse_versions(listed) == versions


@pytest.mark.parametrize(
    ("ours", "theirs", "version"),
    [
        ("1.1,1.2,1.3", "1.1,1.2,1.3,1.4", "1.3"),
        ("1.1,1.2", "1.3", None),
        ("1.1", "", None),
        ("", "1.1", None),
        ("1.9,1.10", "1.9,1.10", "1.10"),
        ("1,1.0", "1.0,1", "1.0"),
        ("2.0,1.9.9", "1.9.9,2.0", "2.0"),
    ],
)
def test_the_highest_common_version_is_agreed_on(ours: str, theirs: str, version: str | None) -> None:
    assert agree(parse_versions(ours), parse_versions(theirs)) == version


@given(st.text())
def test_any_text_is_read_without_an_error_and_can_be_compared(listed: str) -> None:
    versions = parse_versions(listed)
    assert agree(versions, versions) in (None, *versions)
