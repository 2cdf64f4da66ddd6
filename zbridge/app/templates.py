"""Commented configurations for ``zbridge init``: what is common to all protocols, around each protocol's own part."""

from __future__ import annotations

import re
from collections.abc import Sequence

from zbridge.protocol.plugin import Protocol
from zbridge.toml import as_toml

_CONNECT = re.compile(r"^(connect = \[.*?\] *)(#.*)?$", re.MULTILINE)


def addressed(template: str, addresses: Sequence[str]) -> str:
    """Return a robot's template with these addresses as ``device.connect``; comments stay in their column."""

    def write(line: re.Match[str]) -> str:
        return f"connect = {as_toml(addresses)} ".ljust(len(line[1])) + (line[2] or "")

    return _CONNECT.sub(write, template, count=1)


def secured(template: str) -> str:
    """Return a template whose ``[bus]`` table names the files of a certificate and a router."""
    return template.replace(BUS_TEMPLATE, SECURE_BUS_TEMPLATE)


def robot_template(protocol: Protocol) -> str:
    """Return the commented configuration of a gateway; the caller replaces ``{name}`` by the robot's name."""
    head = f"# A gateway for one robot. {protocol.summary}. Start it with: zbridge run FILE\n\n"
    device, heading, options = protocol.template.partition("[device.options]")
    shared = "" if protocol.keyed else SHARED_TEMPLATE
    return f"{head}{ROBOT_TEMPLATE}{device.rstrip()}\n{shared}\n{heading}{options}\n{COMMON_TEMPLATE}"


def listener_template(protocol: Protocol) -> str:
    """Return the commented configuration of a process that only serves HQ programs; ``{name}`` as above."""
    head = "# A listener for HQ programs of one robot. Start it with: zbridge run FILE\n\n"
    listen, heading, options = protocol.hq_template.partition("[hq.options]")
    return (
        f"{head}{ROBOT_TEMPLATE}[[hq]]\n{listen}{LISTENER_TEMPLATE}{heading}{options}\n{BUS_TEMPLATE}"
        f"{METRICS_TEMPLATE}{LOG_TEMPLATE}"
    )


SHARED_TEMPLATE = """\
# allow_shared_address = true           # gateways of other names may use this address too; all of them must say so
"""
METRICS_TEMPLATE = """\
# [metrics]
# listen = "127.0.0.1:9100"             # metrics for Prometheus
"""
LOG_TEMPLATE = """
# [log]                                 # on stderr: docs/how-to/logs.md
# format = "console"                    # lines for people; "json": one object a line, for programs
# level = "info"                        # the least that is written: debug, info, warning, error
"""
BLACKBOX_TEMPLATE = """
[blackbox]                              # the last minutes on disk, kept after an incident: docs/how-to/blackbox.md
minutes = 5.0                           # before a cause; the page says how much is written a day
keep = 20                               # incidents; older ones are deleted
# dir = "/var/lib/zbridge/blackbox"     # may be in memory (tmpfs), for hosts with an SD card; left out: blackbox
                                        # in $STATE_DIRECTORY, or in ~/.local/state/zbridge
# fsync = true                          # wait for the disk each second, so that lost power costs 2 s at most
"""
LISTENER_TEMPLATE = """\
# name = "desk"                         # of the listener on the bus; left out: from its protocol and the process
clients = 256                           # most at a time; further ones are refused
accept_hz = 20.0                        # connections a second from one address; further ones are refused
handshake_s = 5.0                       # longest time for a client's handshake
# idle_s = 60.0                         # close clients that send nothing for so long; left out: never
rate_hz = 1000.0                        # messages a second of one client; a client that sends more is closed
allow = []                              # networks that clients may connect from, ["192.168.1.0/24"]; empty: all
# tls = { certificate = "certificate.pem", key = "key.pem", ca = "ca.pem" }     # with listen = "tls://HOST:PORT"; with
                                        # ca, clients must show a certificate of it; no datagrams then

"""
ROBOT_TEMPLATE = """\
[robot]
name = "{name}"                         # its keys begin with fleet/{name}/
realm = "fleet"                         # the first chunk of all keys of this fleet

"""
BUS_TEMPLATE = """\
[bus]
mode = "peer"                           # peer, client, router (embedded); client when only connect is given
connect = []                            # for example ["tcp/127.0.0.1:7447"]
listen = []                             # where other programs may connect: ["tcp/0.0.0.0:7447"]
multicast = true                        # find peers on the local network
stream = "drop"                         # "block": no loss when the bus is slower than the robot
# tls = { ... }                         # a secure bus: put the [bus] table of `zbridge certs bundle` here instead

"""
SECURE_BUS_TEMPLATE = """\
[bus]
mode = "client"                         # of a router, which knows this process by its certificate
connect = ["tls/router.lab:7447"]       # the router, by a host name in its certificate
multicast = false
stream = "drop"                         # "block": no loss when the bus is slower than the robot
# beside this file, as `zbridge certs bundle NAME -o {name}-bus` makes them:
tls = { ca = "{name}-bus/ca.pem", certificate = "{name}-bus/certificate.pem", key = "{name}-bus/key.pem" }

"""
CAMERA_TEMPLATE = """\
# [camera]                              # the robot streams pictures (MJPEG by HTTP): docs/how-to/camera.md
# url = "http://192.168.0.10:8000/stream.mjpg"  # fetched only while somebody watches
# rate_hz = 30.0                        # most pictures a second on the bus
# stall_s = 5.0                         # a stream without a picture for so long is ended, and fetched anew
# relay = "127.0.0.1:8000"              # HQ programs find /stream.mjpg here, all from one connection to the robot
# clients = 16                          # most clients of the relay at a time
# allow = []                            # networks that they may connect from, ["192.168.1.0/24"]; empty: all

"""
COMMON_TEMPLATE = (
    CAMERA_TEMPLATE
    + """\
# [[hq]]                                # HQ programs connect here as if this were the robot; any number of tables;
# protocol = "alf"                      # zbridge init --hq PROTOCOL prints all settings
# listen = "tcp://127.0.0.1:6667"

"""
    + BUS_TEMPLATE
    + """\
[control]
lease_s = 3.0                           # most a holder may ask for: a lease not renewed for so long ends
deadman_s = 2.0                         # most a holder may ask for: motion without a fresh command ends
max_age_s = 0.4                         # motion that the network delayed longer is refused; 0: off
# rate_hz = 50.0                        # drives a second that are carried out; further ones are refused
# slew_per_s = 2.0                      # how fast a drive may grow, full scales a second; braking is not limited
idle_stop_s = 1.0                       # seconds between stops while nobody drives, in case the robot lost one: 0.1
                                        # or more; 0: a stop only when motion ends
audit = "{name}.audit.jsonl"                # file that says who drove, was refused or stopped the robot
audit_bytes = 1000000                   # the file is rotated at this size
audit_files = 5                         # older files that are always kept
audit_days = 30.0                       # further ones are kept until they are so old, 20 times as many at most

"""
    + METRICS_TEMPLATE
    + LOG_TEMPLATE
    + BLACKBOX_TEMPLATE
)
