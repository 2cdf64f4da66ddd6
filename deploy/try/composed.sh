#!/usr/bin/env bash
# Tests the composition with one fragile robot, in the network namespace that deploy/try/container.sh made. Usage: composed.sh FOLDER
# shellcheck source-path=SCRIPTDIR disable=SC2015
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
cd "$work"
ip link set lo up
# crun supports control groups of version 1 or 2, not both at once.
! mountpoint --quiet /sys/fs/cgroup/unified || umount /sys/fs/cgroup/unified
compose() { podman-compose --file "$root/deploy/container/compose.yaml" "$@" >"$work/compose.log" 2>&1; }
robot='' # the fragile robot serves one connection per start, as legacy ones do: robot() restarts it
robot() {
    [ -z "$robot" ] || { kill "$robot" 2>/dev/null || true; wait "$robot" 2>/dev/null || true; }
    [ "${1:-}" = gone ] || { "$work/tools/bin/python" "$root/deploy/try/robot.py" 11001 r1.account >robot.log 2>&1 & robot=$!; }
}
over() {
    [ "$1" -eq 0 ] || { tail -n 15 compose.log; compose logs || true; tail -n 30 compose.log; tail -n 5 r1.account robot.log; }
    robot gone
    compose down --volumes || true
}
trap 'over $?' EXIT
one_connection() { ! grep -e '^violation' -e 'second connection' -e 'ended' r1.account | grep -v '(this process'; }
driven() { # LIMIT_S COMMAND...: drives r1 while the command runs; r1 must stop within LIMIT_S; sets rest to the time
    rest=$(python "$root/deploy/try/driven.py" ann r1 r1.account "$@" 2>driven.log) || { cat driven.log; fail "$rest"; }
}

robot
compose up -d --no-build || fail "podman-compose up"
established() { python "$root/deploy/try/established.py" wall r1; }
established || fail "r1 is not established"
ok "router, gateways, recorder and console run; r1 is established over mutual TLS"
container() { podman ps --filter "name=$1" --format '{{.Names}}'; }
router=$(container router) gateways=$(container gateways) recorder=$(container recorder) console=$(container console)
for name in $router $gateways $recorder $console; do
    podman exec "$name" sh -c 'touch /x 2>/dev/null' && fail "$name: the root file system is writable"
    podman exec "$name" sh -c 'grep -q "^CapBnd:.0*$" /proc/1/status && grep -q "^NoNewPrivs:.1" /proc/1/status && [ "$(id -u)" = 10001 ]' || fail "$name has capabilities, new privileges or another user"
done
ok "read-only root file systems, no capabilities, user 10001"
within 20 podman healthcheck run "$router" || fail "the router's health check"
ok "the router's health check"
podman exec "$gateways" python3 /opt/zbridge/healthy.py | grep '^1 of 1' >/dev/null || fail "the gateways' check queries no gateway"
podman healthcheck run "$gateways" >/dev/null || fail "the gateways' health check"
ok "the gateways' health check"

metrics=http://127.0.0.1:9100
within 10 answers $metrics/readyz 200 || fail "/readyz"
within 10 answers $metrics/metrics 'zbridge_bus_messages_total{direction="out",kind="pose",.*} [1-9]' || fail "/metrics"
counted=$(page $metrics/metrics | grep '^zbridge_bus_messages_total')
code=0
zbridge health --tls wall >health.log || code=$?
[ $code -eq 0 ] || { cat health.log; fail "zbridge health"; }
ok "zbridge health: $(cat health.log)"
robot gone
within 20 answers $metrics/readyz 503 || fail "/readyz without the robot"
answers $metrics/healthz 200 || fail "/healthz without the robot"
reason=$(page $metrics/readyz | sed -n 3p)
robot
established || fail "r1 is not established again"
within 10 answers $metrics/readyz 200 || fail "/readyz after the robot returned"
ok "/readyz reports the robot (503 without it: $reason), /healthz stays 200; /metrics: $counted"

main() { podman inspect --format '{{.State.Pid}}' "$gateways"; }
supervisor() { pgrep --parent "$(main)" --full 'zbridge run' | head -n 1; }
gateway() { pgrep --ns "$(main)" --nslist pid --exact "zb r1" | head -n 1; }
driven 5 kill -KILL "$(gateway)"
established && one_connection || fail "the robot's connection is lost"
ok "gateway killed: $rest; the next process takes over its connection"
before=$(main)
driven 5 kill -KILL "$(supervisor)"
robot
established || fail "r1 is not established again"
[ "$(main)" != "$before" ] || fail "the container was not restarted"
ok "supervisor killed: $rest; the container was restarted"

seen() { curl --silent --fail --cacert certs/ca.pem -H "Authorization: Bearer $(cat token)" "https://localhost:8443/api/robots/r1/status" | grep -q '"state":"established"'; }
within 20 seen || { curl -v --cacert certs/ca.pem https://localhost:8443/api/me 2>&1 | tail -n 20; fail "the console does not show r1"; }
[ "$(curl --silent --output /dev/null --write-out '%{http_code}' --cacert certs/ca.pem https://localhost:8443/api/robots)" = 401 ] || fail "the console needs no login"
ok "the console shows r1 over TLS to who has a token, and to nobody else"

recorded() { podman exec "$recorder" sh -c 'find /var/lib/zbridge-recorder -name "*.mcap" -size +20k | grep .' 2>/dev/null; }
within 30 recorded || fail "nothing is recorded"
began=$SECONDS
driven 10 podman-compose --file "$root/deploy/container/compose.yaml" stop
[ $((SECONDS - began)) -lt 25 ] || fail "the stop took $((SECONDS - began)) s"
file=$(find "$(podman volume inspect --format '{{.Mountpoint}}' zbridge_recordings)" -name '*.mcap' | sort | tail -n 1)
zbridge info "$file" >info.log || { cat info.log; fail "zbridge info"; }
grep --quiet r1 info.log || { cat info.log; fail "the recording"; }
! grep --ignore-case "cut off" info.log || fail "the recording is cut off"
ok "the recorder resolves the router by name and records r1 over mutual TLS: $(du --block-size=1K "$file" | cut -f 1) kB, complete after a stop"
robot
compose up -d --no-build || fail "second podman-compose up"
established || fail "r1 is not established again"
compose down || fail "podman-compose down"
[ -z "$(podman ps --all --quiet)" ] || fail "containers are left"
ok "composition stopped ($rest), started again, removed"
