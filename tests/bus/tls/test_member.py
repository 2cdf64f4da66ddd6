"""The name that a certificate gives a process."""

from pathlib import Path

import pytest

from tests.certificates import Authority
from zbridge.bus import Tls
from zbridge.bus.tls.files import own_name, own_role
from zbridge.errors import ConfigError


def test_the_name_is_what_follows_the_role_and_nobody_has_one_without_a_certificate(tmp_path: Path) -> None:
    authority = Authority(tmp_path)
    names = {each: authority.issue(each) / "certificate.pem" for each in ("operator.ann", "lab")}
    assert own_name(Tls("ca.pem", str(names["operator.ann"]))) == "ann"
    assert own_name(Tls("ca.pem", str(names["lab"]))) is None
    assert own_role(Tls("ca.pem", str(names["operator.ann"]))) == "operator"
    assert own_role(Tls("ca.pem", str(names["lab"]))) is own_role(None) is None
    assert own_name(Tls("ca.pem")) is own_name(None) is None


def test_a_certificate_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"gone\.pem: No such file"):
        own_name(Tls("ca.pem", str(tmp_path / "gone.pem")))
