"""Who may connect, and who may drive: Origins, tokens, networks, numbers."""

import ipaddress

import pytest

from zbridge.views.foxglove.admission import Admitted, Policy, Rejection, ViewerAdmission

TOKEN = "a" * 32
FOXGLOVE, PAGE, EVIL = "https://app.foxglove.dev", "https://robots.example", "https://evil.example"
SPOKEN = ("foxglove.websocket.v1", "foxglove.sdk.v1")
WITH_TOKEN = f"/?token={TOKEN}"

CASES = [
    # policy, path, origins, subprotocols -> may drive, or why not
    (Policy(), "/", (), SPOKEN, False),
    (Policy(), "/", (FOXGLOVE,), SPOKEN, False),
    (Policy(), "/", (EVIL,), SPOKEN, "origin"),
    (Policy(), "/", (FOXGLOVE, EVIL), SPOKEN, "origin"),
    (Policy(), "/", ("null",), SPOKEN, "origin"),
    (Policy(), "/", ("",), SPOKEN, "origin"),
    (Policy(), "/", (FOXGLOVE + ".evil.example",), SPOKEN, "origin"),
    (Policy(), "/", (), ("foxglove.websocket.v1",), "subprotocol"),
    (Policy(drive=True), "/", (), SPOKEN, False),
    (Policy(drive=True), "/", (FOXGLOVE,), SPOKEN, True),
    (Policy(drive=True, origins=(PAGE,)), "/", (PAGE,), SPOKEN, True),
    (Policy(drive=True, origins=(PAGE,)), "/", (FOXGLOVE,), SPOKEN, "origin"),
    (Policy(drive=True, token=TOKEN), "/", (), SPOKEN, "token"),
    (Policy(drive=True, token=TOKEN), "/", (FOXGLOVE,), SPOKEN, "token"),
    (Policy(drive=True, token=TOKEN), "/?token=" + "b" * 32, (), SPOKEN, "token"),
    (Policy(drive=True, token=TOKEN), "/?token=" + TOKEN[:-1], (), SPOKEN, "token"),
    (Policy(drive=True, token=TOKEN), "/?token=%C3%A4", (), SPOKEN, "token"),
    (Policy(drive=True, token=TOKEN), WITH_TOKEN, (), SPOKEN, True),
    (Policy(drive=True, token=TOKEN), WITH_TOKEN, (EVIL,), SPOKEN, "origin"),
    (Policy(token=TOKEN), WITH_TOKEN, (), SPOKEN, False),
    (Policy(viewers=3), "/", (), SPOKEN, "full"),
]


@pytest.mark.parametrize(("policy", "path", "origins", "subprotocols", "expected"), CASES)
def test_a_handshake_is_admitted_or_turned_away(
    policy: Policy, path: str, origins: tuple[str, ...], subprotocols: tuple[str, ...], expected: bool | str
) -> None:
    decision = ViewerAdmission(policy).admit(path, origins, subprotocols, "10.0.0.7", 3)
    if isinstance(decision, Rejection):
        assert decision.reason == expected
        assert TOKEN not in decision.text
    else:
        assert decision.may_drive is expected


@pytest.mark.parametrize(
    ("path", "label"),
    [("/", "10.0.0.7"), ("/?name=anna", "anna"), ("/?name=" + "x" * 99, "x" * 24), ("/?name=%00/*", "%00%2F%2A")],
)
def test_a_viewer_is_called_as_it_says_as_far_as_keys_can_hold_it(path: str, label: str) -> None:
    decision = ViewerAdmission(Policy()).admit(path, (), SPOKEN, "10.0.0.7", 0)
    assert isinstance(decision, Admitted)
    assert decision.label == label


def test_connections_are_refused_by_network_by_rate_and_by_number_before_they_say_anything() -> None:
    near = ViewerAdmission(Policy(networks=(ipaddress.ip_network("10.0.0.0/8"),), viewers=4))
    assert near.refusal("192.168.0.1", 0, 0.0) == "network"
    assert near.refusal("::ffff:10.1.2.3", 0, 0.0) is None
    assert near.refusal("10.1.2.4", 8, 0.0) == "full"
    refused = [near.refusal("10.1.2.5", 0, 1.0) for _ in range(25)]
    assert refused == [None] * 20 + ["arrivals"] * 5
