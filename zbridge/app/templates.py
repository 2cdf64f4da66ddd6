"""Commented configurations for ``zbridge init``: what all protocols share, around what each protocol contributes."""

from __future__ import annotations

from zbridge.protocol.plugin import Protocol


def robot_template(protocol: Protocol) -> str:
    """Give the commented configuration of a gateway; ``{name}`` stands for the robot's name."""
    head = f"# A gateway for one robot. {protocol.summary}. Start it with: zbridge run FILE\n\n"
    return f"{head}{ROBOT_TEMPLATE}{protocol.template}\n{COMMON_TEMPLATE}"


def listener_template(protocol: Protocol) -> str:
    """Give the commented configuration of a process that only serves HQ programs of a robot, as ``{name}``."""
    head = "# A listener for HQ programs of one robot. Start it with: zbridge run FILE\n\n"
    listen, heading, options = protocol.hq_template.partition("[hq.options]")
    return (
        f"{head}{ROBOT_TEMPLATE}[[hq]]\n{listen}{LISTENER_TEMPLATE}{heading}{options}\n{BUS_TEMPLATE}{METRICS_TEMPLATE}"
    )


METRICS_TEMPLATE = """\
# [metrics]
# listen = "127.0.0.1:9100"             # counters for Prometheus
"""
LISTENER_TEMPLATE = """\
# name = "desk"                         # of the listener on the bus; left out: made of its protocol and the process
clients = 256                           # most at a time; one more is turned away
accept_hz = 20.0                        # connections a second of one address; what is more is closed at once
handshake_s = 5.0                       # what a client has for its handshake
# idle_s = 60.0                         # close clients that say nothing for so long; left out: they may be silent
rate_hz = 1000.0                        # messages a second of one client; one that sends more is closed
allow = []                              # networks that clients may come from, ["192.168.1.0/24"]; empty: all

"""
ROBOT_TEMPLATE = """\
[robot]
name = "{name}"                         # its keys begin with fleet/{name}/
realm = "fleet"

"""
BUS_TEMPLATE = """\
[bus]
mode = "peer"                           # peer, client, router (embedded); client when only connect is given
connect = []                            # for example ["tcp/127.0.0.1:7447"]
listen = []
multicast = true                        # find peers on the local network
stream = "drop"                         # "block": lose nothing when the bus is slower than the robot

"""
COMMON_TEMPLATE = (
    """\
# [[hq]]                                # HQ programs connect here as if this were the robot, any number of them;
# protocol = "alf"                      # zbridge init --hq PROTOCOL prints all there is to set
# listen = "tcp://127.0.0.1:6667"

"""
    + BUS_TEMPLATE
    + """\
[control]
lease_s = 3.0                           # the most a holder may ask for: a lease not renewed for so long ends
deadman_s = 2.0                         # the most a holder may ask for: motion without a fresh command ends
# rate_hz = 50.0                        # drives a second that are carried out, the others are refused
# slew_per_s = 2.0                      # how fast a drive may grow, full scales a second; braking is never slowed
idle_stop_s = 1.0                       # a stop so often while nobody drives: it may lose those that end motion;
                                        # 0: only when motion ends
audit = "{name}.audit.jsonl"                # who drove, was refused, stopped it: a file in the working directory,
audit_bytes = 1000000                   # rotated at this size,
audit_files = 5                         # with so many older ones kept,
audit_days = 30.0                       # and more of them, up to 20 times as many, that are younger than this

"""
    + METRICS_TEMPLATE
)
