"""The parameters that ground stations are told: a dozen, true of the gateway, and never changed. Sans-IO.

Source: "The gateway as vehicle" of the protocol page: without parameters QGC offers no setup.
"""

from __future__ import annotations

from gateways.mavlink.messages.control import ParamRequestRead, ParamSet, ParamValue
from gateways.mavlink.numbers import RoverMode
from gateways.mavlink.station.options import MavlinkHqOptions

_FLOAT = 9
_STOPS = 2
_NAME_BYTES = 16


class Parameters:
    """The parameters of one listener. deadman_s: after which motion that is not repeated ends, whatever its kind."""

    def __init__(self, options: MavlinkHqOptions, deadman_s: float) -> None:
        values = {
            "SYSID_THISMAV": options.system_id,
            "SYSID_MYGCS": 255,
            "FRAME_CLASS": 2 if options.kind == "boat" else 1,
            "INITIAL_MODE": RoverMode.HOLD,
            "ARMING_CHECK": 1,
            "FS_GCS_ENABLE": 1,
            "FS_GCS_TIMEOUT": deadman_s,
            "FS_ACTION": _STOPS,
            "GUID_TIMEOUT": deadman_s,
            "RC_OVERRIDE_TIME": deadman_s,
            "PILOT_STEER_TYPE": 1,
            "RCMAP_ROLL": 1,
            "RCMAP_THROTTLE": 3,
            "CRUISE_SPEED": options.speed_full_m_s,
            "WP_SPEED": options.speed_full_m_s,
        }
        self.all = tuple(
            ParamValue(float(value), len(values), index, name.encode().ljust(_NAME_BYTES, b"\0"), _FLOAT)
            for index, (name, value) in enumerate(values.items())
        )
        self._by_name = {value.param_id: value for value in self.all}

    def __repr__(self) -> str:
        return f"<Parameters {len(self.all)}>"

    def find(self, message: ParamRequestRead | ParamSet) -> ParamValue | None:
        """Return the parameter that is asked for, or that somebody wants to set; None: there is no such one."""
        index = message.param_index if isinstance(message, ParamRequestRead) else -1
        if index < 0:
            return self._by_name.get(message.param_id)
        return self.all[index] if index < len(self.all) else None
