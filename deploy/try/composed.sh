#!/usr/bin/env bash
# Runs in the network that deploy/try/container.sh made: the composition with one simulated robot.
# shellcheck source-path=SCRIPTDIR disable=SC2154
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
ip link set lo up
# crun knows control groups of either kind, not both at once.
! mountpoint --quiet /sys/fs/cgroup/unified || umount /sys/fs/cgroup/unified
compose() { podman-compose --file "$root/deploy/container/compose.yaml" "$@" >"$work/compose.log" 2>&1; }
say() { tail -n 15 "$work/compose.log"; compose logs || true; tail -n 20 "$work/compose.log"; }
zbridge simulate tcpudp --listen tcp://127.0.0.1:11001 >/dev/null 2>&1 &
simulator=$!
# The containers' runtime gives its standard input, /dev/null, to the container's user.
trap 'kill $simulator; compose down --volumes || true; chown root:root /dev/null' EXIT

compose up -d --no-build router gateways || { say; fail "podman-compose up"; }
python "$root/deploy/try/established.py" --folder "$work/certs" r1 || { say; fail "r1 is not established"; }
ok "router and gateways run; r1 is established over mutual TLS"
router=$(podman ps --filter name=router --format '{{.Names}}') gateways=$(podman ps --filter name=gateways --format '{{.Names}}')
for name in $router $gateways; do
    podman exec "$name" sh -c 'touch /x 2>/dev/null' && fail "$name: the root is writable"
    podman exec "$name" sh -c 'grep -q "^CapBnd:.0*$" /proc/1/status && grep -q "^NoNewPrivs:.1" /proc/1/status && [ "$(id -u)" = 10001 ]' || fail "$name has rights"
done
ok "read-only roots, no capabilities, user 10001"
podman healthcheck run "$router" >/dev/null || fail "the router's check"
ok "the router's check"
podman exec "$gateways" python3 /opt/zbridge/healthy.py | grep --quiet '^1 of 1' || fail "the gateways' check asks nobody"
podman healthcheck run "$gateways" >/dev/null || fail "the gateways' check"
ok "the gateways' check"
began=$SECONDS
compose down || { say; fail "podman-compose down"; }
[ $((SECONDS - began)) -lt 15 ] || fail "the end takes $((SECONDS - began)) s"
ok "down in $((SECONDS - began)) s"
