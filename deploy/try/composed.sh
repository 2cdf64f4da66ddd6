#!/usr/bin/env bash
# Runs in the network that deploy/try/container.sh made: the composition with one simulated robot. Usage: composed.sh FOLDER
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
cd "$work"
ip link set lo up
# crun knows control groups of either kind, not both at once.
! mountpoint --quiet /sys/fs/cgroup/unified || umount /sys/fs/cgroup/unified
compose() { podman-compose --file "$root/deploy/container/compose.yaml" "$@" >"$work/compose.log" 2>&1; }
simulate() {
    zbridge simulate tcpudp --listen tcp://127.0.0.1:11001 >/dev/null 2>&1 &
    simulator=$!
}
simulate
over() {
    [ "$1" -eq 0 ] || { tail -n 15 compose.log; compose logs || true; tail -n 30 compose.log; }
    kill $simulator 2>/dev/null || true
    compose down --volumes || true
}
trap 'over $?' EXIT

compose up -d --no-build || fail "podman-compose up"
established() { python "$root/deploy/try/established.py" wall r1; }
established || fail "r1 is not established"
ok "router, gateways and recorder run; r1 is established over mutual TLS"
container() { podman ps --filter "name=$1" --format '{{.Names}}'; }
router=$(container router) gateways=$(container gateways) recorder=$(container recorder)
for name in $router $gateways $recorder; do
    podman exec "$name" sh -c 'touch /x 2>/dev/null' && fail "$name: the root is writable"
    podman exec "$name" sh -c 'grep -q "^CapBnd:.0*$" /proc/1/status && grep -q "^NoNewPrivs:.1" /proc/1/status && [ "$(id -u)" = 10001 ]' || fail "$name has rights"
done
ok "read-only roots, no capabilities, user 10001"
within 20 podman healthcheck run "$router" || fail "the router's check"
ok "the router's check"
podman exec "$gateways" python3 /opt/zbridge/healthy.py | grep '^1 of 1' >/dev/null || fail "the gateways' check asks nobody"
podman healthcheck run "$gateways" >/dev/null || fail "the gateways' check"
ok "the gateways' check"

metrics=http://127.0.0.1:9100
within 10 answers $metrics/readyz 200 || fail "/readyz"
within 10 answers $metrics/metrics 'zbridge_published_total [1-9]' || fail "/metrics"
counted=$(page $metrics/metrics | grep '^zbridge_published_total')
kill $simulator
within 20 answers $metrics/readyz 503 || fail "/readyz without the robot"
answers $metrics/healthz 200 || fail "/healthz without the robot"
reason=$(page $metrics/readyz | sed -n 3p)
simulate
established || fail "r1 is not back"
within 10 answers $metrics/readyz 200 || fail "/readyz when the robot is back"
ok "/readyz follows the robot (without it 503: $reason), /healthz does not; /metrics: $counted"
code=0
zbridge health --tls wall >health.log || code=$?
[ $code -lt 2 ] || { cat health.log; fail "zbridge health"; }
ok "zbridge health: $(cat health.log)"

recorded() { podman exec "$recorder" sh -c 'find /var/lib/zbridge-recorder -name "*.mcap" -size +20k | grep .' 2>/dev/null; }
within 30 recorded || fail "nothing is recorded"
began=$SECONDS
compose stop || fail "podman-compose stop"
[ $((SECONDS - began)) -lt 25 ] || fail "the end takes $((SECONDS - began)) s"
took=$((SECONDS - began))
file=$(find "$(podman volume inspect --format '{{.Mountpoint}}' zbridge_recordings)" -name '*.mcap' | sort | tail -n 1)
zbridge info "$file" >info.log || { cat info.log; fail "zbridge info"; }
grep --quiet r1 info.log || { cat info.log; fail "the recording"; }
! grep --ignore-case "cut off" info.log || fail "the recording is cut off"
ok "the recorder finds the router by its name and records r1 over mutual TLS: $(du --block-size=1K "$file" | cut -f 1) kB, whole after a stop"
compose up -d --no-build || fail "podman-compose up, again"
established || fail "r1 is not established again"
compose down || fail "podman-compose down"
[ -z "$(podman ps --all --quiet)" ] || fail "containers are left"
ok "stopped in $took s, started again, down"
