"""Every metric of zbridge: its name, type, labels and meaning. A reader of ``/metrics`` sees exactly these texts.

Names and units follow Prometheus: base units, ``_total`` for what only grows. Label values come from closed sets (a
word of the code, or of the configuration), never from a peer. A protocol that is not in this table counts under names
of its own, with a ``help`` text (:meth:`Metrics.count`).
"""

from __future__ import annotations

from enum import Enum

import msgspec


class MetricKind(Enum):
    """The type of a metric, as Prometheus calls it."""

    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


class Family(msgspec.Struct, frozen=True):
    """One metric. name: in the code; :attr:`full_name` is what readers see. labels: but for ``realm`` and ``robot``."""

    name: str
    kind: MetricKind
    help: str
    labels: tuple[str, ...] = ()

    @property
    def full_name(self) -> str:
        """The name in the exposition: with the prefix, and ``_total`` for a counter."""
        name = self.name if self.name.startswith("process_") else f"zbridge_{self.name}"
        return f"{name}_total" if self.kind is MetricKind.COUNTER else name


def _counters(*rows: tuple[str, str] | tuple[str, str, str]) -> tuple[Family, ...]:
    return tuple(_family(MetricKind.COUNTER, *row) for row in rows)


def _gauges(*rows: tuple[str, str] | tuple[str, str, str]) -> tuple[Family, ...]:
    return tuple(_family(MetricKind.GAUGE, *row) for row in rows)


def _family(kind: MetricKind, name: str, text: str, labels: str = "") -> Family:
    return Family(name, kind, text, tuple(labels.split()))


GROUPS: dict[str, tuple[Family, ...]] = {
    "Process": (
        *_gauges(
            ("build_info", "Versions of this process; always 1.", "version python zenoh"),
            ("process_resident_memory_bytes", "Resident memory."),
            ("process_open_fds", "Open file descriptors."),
            ("process_max_fds", "Most file descriptors that the process may open."),
            ("process_start_time_seconds", "Start of the process, Unix time."),
        ),
        *_counters(("process_cpu_seconds", "Processor time used.")),
        Family("event_loop_lateness_seconds", MetricKind.HISTOGRAM, "Delay of a timer of the event loop."),
    ),
    "Robot": (
        *_gauges(
            ("robot_state", "1 for the state that the robot is in, as on status; 0 for the others.", "state"),
            ("robot_info", "Protocol of the robot; always 1.", "protocol"),
            ("link_stalled", "1 while the robot's link accepts no bytes."),
            ("sessions", "Sessions with robots (role hq) and HQ programs (role robot).", "role state version"),
        ),
        *_counters(
            (
                "robot_connections",
                "Connections to the robot that were established, failed before that, or were lost.",
                "link outcome",
            ),
            ("link_bytes", "Bytes of robots (role hq) and HQ programs (role robot).", "role direction"),
            ("link_frames", "Frames of robots (role hq) and HQ programs (role robot).", "role direction"),
            ("malformed_frames", "Frames of the robot that could not be decoded."),
            ("foreign_datagrams", "Datagrams from addresses that are not the robot's."),
            ("surplus_datagrams", "Datagrams beyond the share of one robot of a shared process."),
            ("untranslatable_messages", "Messages of the robot that have no valid fleet message."),
            ("names_dropped", "Sensors and motors beyond the number of names that is kept."),
            ("link_stalls", "Times that the robot's link accepted no bytes."),
            ("commands_lost", "Frames that waited when the robot was lost."),
            ("drives_unwritten", "Drives and motor commands that waited for a stalled link until their deadman."),
        ),
        Family(
            "socket_to_bus_seconds",
            MetricKind.HISTOGRAM,
            "Time from reading the robot's socket until its messages are with Zenoh, or in the queue for it;"
            " 20 reads a second at most.",
        ),
        Family(
            "bus_to_socket_seconds",
            MetricKind.HISTOGRAM,
            "Time from the arrival of a command until it is handled: written or refused, or waiting for a slow robot.",
        ),
    ),
    "Control": (
        *_gauges(
            ("lease_held", "1 while a program has the lease."),
            ("robot_driven", "1 while a program drives the robot."),
            ("latches", "Latched stops in force."),
            ("fault_open", "1 while the fault is open.", "code"),
        ),
        *_counters(
            ("lease_changes", "Changes of the lease: acquired, taken_over, released, ended.", "change"),
            ("stops", "Stops of the robot, by what caused them.", "cause"),
            ("latch_changes", "Latched stops that came into force, and that were released.", "change"),
            ("refused", "Commands and queries that were refused.", "code"),
            ("faults", "Faults that have opened.", "code"),
            ("drives_slowed", "Drives that slew_per_s limited."),
            ("stops_folded", "Stops that changed nothing, within 50 ms of one that was carried out."),
            ("audit_write_failures", "Failed attempts to write the audit log."),
            ("audit_lines_dropped", "Lines of the audit log that were lost."),
        ),
    ),
    "Black box": _counters(
        ("blackbox_bytes", "Bytes written to the black box."),
        ("blackbox_lost", "Messages that the black box lost: the queue was full, or the disk took nothing.", "reason"),
        ("blackbox_incidents", "Incidents that were kept, by the code of their first cause.", "code"),
        ("blackbox_incidents_removed", "Incidents that were deleted to make room for newer ones."),
    ),
    "Bus": (
        *_gauges(
            (
                "bus_connected",
                "1 while the process is connected to another one on the bus, or a peer that may be alone.",
            ),
            ("queue_length", "Messages that wait in a queue.", "queue"),
        ),
        *_counters(
            ("bus_messages", "Messages published (out) and commands received (in).", "direction kind"),
            ("bus_bytes", "Bytes of their payloads.", "direction kind"),
            ("bus_dropped", "Messages dropped from a full queue.", "queue"),
            ("bus_replaced", "Messages replaced by a newer one before they were written.", "queue"),
            ("bus_stops_folded", "Equal stops that waited, served as one."),
            ("bus_queries_unanswered", "Queries that ended without an answer."),
            ("gateway_failures", "Gateways of a shared process that ended with an exception."),
        ),
    ),
    "Listeners for HQ programs": _counters(
        ("hq_connections", "Connections of HQ programs: accepted, or turned_away.", "listener outcome"),
        ("hq_commands", "Commands and queries of HQ programs.", "listener"),
        ("hq_refused", "Commands and queries of HQ programs that were refused.", "listener"),
        ("hq_malformed_frames", "Frames of HQ programs that could not be decoded.", "listener"),
        ("hq_dropped", "Messages dropped from a client's full queue.", "listener"),
        ("hq_left_out", "Messages that the listener's protocol could not show.", "listener"),
        ("hq_foreign_datagrams", "Datagrams that no client claimed.", "listener"),
        ("hq_rival_sources", "Clients that lost their source of datagrams to another one.", "listener"),
        ("hq_refusals_untold", "Refusals beyond the sixteen that one report holds.", "listener"),
        ("telemetry_malformed", "Messages of the bus that could not be decoded."),
    ),
    "Camera": _counters(
        ("camera_pictures", "Pictures received from the camera."),
        ("camera_published", "Pictures published."),
        ("camera_rate_dropped", "Pictures beyond rate_hz."),
        ("camera_not_jpeg", "Parts of the stream that are no JPEG picture."),
        ("camera_failures", "Streams that failed or ended."),
        ("camera_relay_accepted", "HQ programs that were accepted."),
        ("camera_relay_refused", "HQ programs that were refused."),
        ("camera_relay_pictures", "Pictures sent to HQ programs."),
        ("camera_relay_skipped", "Pictures skipped for a slow HQ program."),
    ),
    "Supervisor": (
        *_gauges(
            ("gateway_up", "1 if the robot's gateway answered this scrape, else 0."),
            ("faulty_files", "Robot files that cannot be used."),
        ),
        *_counters(("gateway_restarts", "Processes started in place of one that died.")),
    ),
    "Views": _counters(
        ("console_commands_dropped", "Commands of pages that moved nothing.", "reason"),
        ("console_requests_refused", "HTTP requests refused.", "status"),
        ("console_connections_refused", "Connections refused.", "reason"),
        ("console_keys_left_out", "Keys beyond the number that a page is shown."),
        ("foxglove_refused", "Viewers refused.", "reason"),
        ("foxglove_viewer_messages", "Messages of viewers that were dropped, malformed or refused.", "what"),
        ("foxglove_malformed", "Messages of the bus that could not be decoded."),
        ("foxglove_channels_left_out", "Keys beyond the number of channels."),
        ("ros2_sent", "Messages sent to ROS 2."),
        ("ros2_not_encoded", "Messages that could not be encoded."),
        ("ros2_malformed", "Messages of the bus that could not be decoded."),
        ("ros2_unusable", "Messages that ROS has no form for."),
        ("ros2_robots_left_out", "Robots beyond the number that is shown."),
        ("ros2_stamps_clamped", "Time stamps that ROS cannot express."),
        ("ros2_calls", "Service calls."),
        ("ros2_calls_refused", "Service calls refused."),
        ("ros2_cmd_vel_refused", "Twists refused."),
        ("ros2_cmd_vel_malformed", "Twists that could not be decoded."),
        ("ros2_cmd_vel_too_fast", "Twists beyond the rate."),
        ("ros2_cmd_vel_wrong_type", "Twists of another type."),
        ("ros2_cmd_vel_strangers", "Twists of unknown publishers."),
        ("ros2_cmd_vel_publishers_refused", "Publishers beyond the number that is followed."),
        ("ros2_cmd_vel_tokens_unreadable", "Liveliness tokens that could not be read."),
    ),
}
"""The metrics of the core, by the part of the program that they tell of."""

FAMILIES = {family.name: family for families in GROUPS.values() for family in families}
"""The same, by name."""
