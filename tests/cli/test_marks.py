"""``zbridge mark`` on a secure bus: who may not is told, for the router would drop the mark without a word."""

from pathlib import Path

import pytest

from tests.certificates import Authority
from zbridge.bus import BusSettings, Tls
from zbridge.cli.recording import put_mark
from zbridge.errors import ConfigError


async def test_a_viewer_may_not_mark(tmp_path: Path) -> None:
    certificate = Authority(tmp_path / "lab").issue("viewer.vi") / "certificate.pem"
    settings = BusSettings(connect=["tls/127.0.0.1:1"], tls=Tls("ca.pem", str(certificate)))
    with pytest.raises(ConfigError, match="a viewer may not mark: expected the certificate of an operator"):
        await put_mark(settings, "fleet", "text", None)
