# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: gateways and supervisors that die or hang while r1 moves; the ways in which a unit ends. r1's own account tells when it was at rest.

pid=$(gateway r1)
driven 5 kill -KILL "$pid"
established r1 r2 && [ "$(gateway r1)" != "$pid" ] || fail "no gateway after a crash"
one_connection r1 || fail "the robot's connection is lost"
ok "a gateway is killed: $rest, over the supervisor's duplicate of its connection; the next process goes on with that connection"

robot r1 11001
established r1 || fail "r1 is not established"
driven 5 kill -STOP "$(gateway r1)"
ok "a gateway hangs: $rest"
is NRestarts zbridge 0 || fail "the unit was restarted"

robot r1 11001
established r1 r2 || fail "r1 is not established"
since=$(now) began=$SECONDS
driven 10 systemctl stop zbridge
[ $((SECONDS - began)) -lt 25 ] || fail "the stop takes $((SECONDS - began)) s"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "the gateways are not stopped in order"
is Result zbridge success || fail "the stop is called a failure"
robot r1 11001
systemctl start zbridge
established r1 r2 || fail "no start after a stop"
ok "the unit is stopped, and started: $rest"

since=$(now)
driven 10 kill -KILL "$(of MainPID zbridge)"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "a dead supervisor's gateways go on"
robot r1 11001
established r1 r2 || fail "no start after a crash"
is NRestarts zbridge 1 || fail "systemd has not started it anew"
ok "the supervisor is killed: $rest; systemd starts the unit anew"

since=$(now)
driven 40 kill -STOP "$(of MainPID zbridge)"
within 40 said zbridge "$since" "Watchdog timeout" || fail "a hung supervisor is not found"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "a hung supervisor's gateways are not stopped in order"
robot r1 11001
established r1 r2 || fail "no start after a hang"
ok "the supervisor hangs (SIGSTOP): $rest, found by the watchdog (15 s); systemd starts the unit anew"

driven 45 kill -STOP "$(of MainPID zbridge)" "$(gateway r1)"
robot r1 11001
established r1 r2 || fail "no start after a hang of both"
ok "supervisor and gateway hang: $rest; systemd starts the unit anew"

systemctl restart zbridge-router
established r1 r2 || fail "the router's restart"
one_connection r1 || fail "the robot's connection is lost"
ok "the router restarts: the gateways come back, r1 keeps its connection"

systemctl stop zbridge
mv /etc/zbridge/robots/r1.toml /etc/zbridge/single/
robot r1 11001
systemctl start zbridge zbridge@r1
established r1 r2 || fail "zbridge@r1"
echo "[robot" >/etc/zbridge/single/bad.toml
systemctl start zbridge@bad || true
within 10 is Result zbridge@bad exit-code || fail "a bad file is no failure"
sleep 3
is NRestarts zbridge@bad 0 || fail "a bad file is tried again and again"
ok "a unit for one robot; a bad file is not tried again"
main=$(of MainPID zbridge@r1)
zbridge restart r1 --tls boss >/dev/null || fail "zbridge restart r1"
sleep 1
[ "$(of MainPID zbridge@r1)" != "$main" ] && is ActiveState zbridge@r1 active && is NRestarts zbridge@r1 0 || fail "systemd has not followed the restart"
established r1 && one_connection r1 || fail "the robot's connection is lost"
ok "zbridge restart in a unit for one robot: systemd follows the new process, r1 keeps its connection"
systemctl stop zbridge@r1
rm /etc/zbridge/single/bad.toml
mv /etc/zbridge/single/r1.toml /etc/zbridge/robots/
robot r1 11001
systemctl reload zbridge
established r1 r2 || fail "r1 is not back under the supervisor"
