# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: the recorder, the probes, zbridge health.

recordings() { find /var/lib/private/zbridge-recorder -name '*.mcap' "$@" | sort; }
recorded() { [ -n "$(recordings -size +20k)" ]; }
within 30 recorded || fail "nothing is recorded"
systemctl stop zbridge-recorder
is Result zbridge-recorder success || fail "systemd reports the recorder's stop as a failure"
file=$(recordings -size +20k | tail -n 1)
zbridge info "$file" >info.log || { cat info.log; fail "zbridge info"; }
grep --quiet r1 info.log && grep --quiet r2 info.log && ! grep --ignore-case "cut off" info.log || { cat info.log; fail "the recording"; }
systemctl start zbridge-recorder
ok "the recorder records r1 and r2 over mutual TLS: $(du --block-size=1K "$file" | cut -f 1) kB, complete after a stop"

robot r1 11001
start_of r2 zbridge simulate tcpudp --listen tcp://127.0.0.1:11011
established r1 r2 || fail "new robots are not established"
health() { zbridge health --tls wall >health.log; }
within 20 health || { cat health.log; fail "zbridge health"; }
within 10 answers http://127.0.0.1:9101/readyz 200 || fail "/readyz of r1"
within 10 answers http://127.0.0.1:9101/healthz 200 || fail "/healthz of r1"
within 10 answers http://127.0.0.1:9101/metrics 'zbridge_bus_messages_total{direction="out",kind="pose",.*} [1-9]' || fail "/metrics of r1"
ok "zbridge health: $(cat health.log); /readyz, /healthz; /metrics: $(page http://127.0.0.1:9101/metrics | grep '^zbridge_bus_messages_total')"

end_of r2

within 20 answers http://127.0.0.1:9102/readyz 503 || fail "/readyz of r2 without its robot"
answers http://127.0.0.1:9102/healthz 200 || fail "/healthz of r2 without its robot"
critical() { health; [ $? -eq 2 ]; }
within 20 critical || { cat health.log; fail "zbridge health without r2"; }
answers http://127.0.0.1:9101/readyz 200 || fail "/readyz of r1 while r2 is offline"
ok "r2's robot is offline: /readyz 503 ($(page http://127.0.0.1:9102/readyz | tail -n 2 | head -n 1)), zbridge health: $(cat health.log)"
start_of r2 zbridge simulate tcpudp --listen tcp://127.0.0.1:11011
established r1 r2 || fail "r2 is not established again"
