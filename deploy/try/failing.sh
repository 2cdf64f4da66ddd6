# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: gateways and supervisors die or hang while r1 moves; units are stopped. r1's own record shows when it stopped.

pid=$(gateway r1)
driven 5 kill -KILL "$pid"
established r1 r2 && [ "$(gateway r1)" != "$pid" ] || fail "no new gateway after a crash"
one_connection r1 || fail "the robot's connection is lost"
ok "gateway killed: $rest, by the supervisor's duplicate of its connection; the next process takes over that connection"

robot r1 11001
established r1 || fail "r1 is not established"
driven 5 kill -STOP "$(gateway r1)"
ok "gateway hung: $rest"
is NRestarts zbridge 0 || fail "the unit was restarted"

robot r1 11001
established r1 r2 || fail "r1 is not established"
since=$(now) began=$SECONDS
driven 10 systemctl stop zbridge
[ $((SECONDS - began)) -lt 25 ] || fail "the stop took $((SECONDS - began)) s"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "the gateways did not shut down in order"
is Result zbridge success || fail "systemd reports the stop as a failure"
robot r1 11001
systemctl start zbridge
established r1 r2 || fail "the robots are not established after a stop and a start"
ok "unit stopped and started: $rest"

since=$(now)
driven 10 kill -KILL "$(of MainPID zbridge)"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "the gateways of a dead supervisor continue"
robot r1 11001
established r1 r2 || fail "the robots are not established after a crash"
is NRestarts zbridge 1 || fail "systemd did not restart the unit"
ok "supervisor killed: $rest; systemd restarted the unit"

since=$(now)
driven 40 kill -STOP "$(of MainPID zbridge)"
within 40 said zbridge "$since" "Watchdog timeout" || fail "the watchdog did not detect a hung supervisor"
within 20 said zbridge "$since" "r1 robot: gateway stopped" || fail "the gateways of a hung supervisor did not shut down in order"
robot r1 11001
established r1 r2 || fail "the robots are not established after a hang"
ok "supervisor hung (SIGSTOP): $rest, detected by the watchdog (15 s); systemd restarted the unit"

driven 45 kill -STOP "$(of MainPID zbridge)" "$(gateway r1)"
robot r1 11001
established r1 r2 || fail "the robots are not established after both hung"
ok "supervisor and gateway hung: $rest; systemd restarted the unit"

systemctl restart zbridge-router
established r1 r2 || fail "the robots are not established after the router's restart"
one_connection r1 || fail "the robot's connection is lost"
ok "router restarted: the gateways reconnected, r1 kept its connection"

systemctl stop zbridge
mv /etc/zbridge/robots/r1.toml /etc/zbridge/single/
robot r1 11001
systemctl start zbridge zbridge@r1
established r1 r2 || fail "zbridge@r1 does not serve r1"
echo "[robot" >/etc/zbridge/single/bad.toml
systemctl start zbridge@bad || true
within 10 is Result zbridge@bad exit-code || fail "zbridge@bad did not fail"
sleep 3
is NRestarts zbridge@bad 0 || fail "systemd restarts a unit with a faulty file"
ok "a unit for one robot; a faulty file is not retried"
main=$(of MainPID zbridge@r1)
zbridge restart r1 --tls boss >/dev/null || fail "zbridge restart r1"
sleep 1
[ "$(of MainPID zbridge@r1)" != "$main" ] && is ActiveState zbridge@r1 active && is NRestarts zbridge@r1 0 || fail "systemd did not follow the restart"
established r1 && one_connection r1 || fail "the robot's connection is lost"
ok "zbridge restart in a unit for one robot: systemd followed the new process, r1 kept its connection"
systemctl stop zbridge@r1
rm /etc/zbridge/single/bad.toml
mv /etc/zbridge/single/r1.toml /etc/zbridge/robots/
robot r1 11001
systemctl reload zbridge
established r1 r2 || fail "r1 is not established under the supervisor again"
