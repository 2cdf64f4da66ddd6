"""The ``[control]`` table of a configuration."""

from __future__ import annotations

from typing import Annotated

import msgspec

from zbridge.control.holders import MAX_AGE_S

Seconds = Annotated[float, msgspec.Meta(gt=0, le=3600)]

LEAST_IDLE_STOP_S = 0.1


class ControlSettings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The most that a holder may ask for (seconds), limits on motion, and the audit log.

    rate_hz: drives a second that are carried out. slew_per_s: change of each part of a drive, full scales a second.
    max_age_s: a dated command that comes so much later than the fastest is not obeyed; 0: however late.
    idle_stop_s: seconds between two stops while nobody drives; 0: a stop is sent only when motion ends.
    audit: the file of the audit log, rotated at ``audit_bytes``; ``audit_files`` older files are kept, and more of them
    while they are younger than ``audit_days``.
    """

    lease_s: Seconds = 3.0
    deadman_s: Seconds = 2.0
    max_age_s: Annotated[float, msgspec.Meta(ge=0, le=60)] = MAX_AGE_S
    idle_stop_s: Annotated[float, msgspec.Meta(ge=0, le=3600)] = 1.0
    rate_hz: Annotated[float, msgspec.Meta(gt=0)] | None = None
    slew_per_s: Annotated[float, msgspec.Meta(gt=0)] | None = None
    audit: Annotated[str, msgspec.Meta(min_length=1)] | None = None
    audit_bytes: Annotated[int, msgspec.Meta(ge=1000)] = 1_000_000
    audit_files: Annotated[int, msgspec.Meta(ge=1)] = 5
    audit_days: Annotated[float, msgspec.Meta(ge=0)] = 30.0

    def __post_init__(self) -> None:
        """Raise ValueError if stops would come more often than robots can take."""
        if 0 < self.idle_stop_s < LEAST_IDLE_STOP_S:
            raise ValueError(f"idle_stop_s: expected 0, or at least {LEAST_IDLE_STOP_S:g}")
