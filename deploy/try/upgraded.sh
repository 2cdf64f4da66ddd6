# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: another version is installed while the services run, then a broken one.

runs() { # VERSION: succeeds if the gateways of r1 and r2 report this version
    local port
    for port in 9101 9102; do page "http://127.0.0.1:$port/metrics" | grep "zbridge=$1" >/dev/null || return 1; done
}
taken_over() { said zbridge "$since" "the installed code has taken over"; }

! runs 0.2.1 || fail "the gateways report 0.2.1 before the upgrade"
main=$(of MainPID zbridge) starts=$(of NRestarts zbridge) since=$(now)
cp later-0.2.1/*.whl wheels/
install --wheels wheels --router
grep --quiet "installed zbridge==0.2.1" install.log || fail "0.2.1 is not installed"
! runs 0.2.1 && one_connection r1 || fail "install.sh disturbed the running services"
systemctl reload zbridge
within 60 taken_over || fail "the supervisor did not load the installed code"
driven 30 zbridge restart --all --tls boss
within 10 runs 0.2.1 || fail "the gateways do not report 0.2.1 after the upgrade"
[ "$(of MainPID zbridge)" = "$main" ] && is NRestarts zbridge "$starts" || fail "the unit was restarted"
established r1 r2 && one_connection r1 || fail "the robot's connection is lost"
ok "upgraded without a stop (install.sh, systemctl reload, zbridge restart --all): $rest; the unit's process and r1's connection are the same"

cp -a /opt/zbridge before # the program that requests the restart has a version of its own, which works
since=$(now)
install --wheels later-0.2.2/zbridge-0.2.2-py3-none-any.whl --extras "" --router
systemctl reload zbridge
within 60 said zbridge "$since" "the old code continues\|continues with the old code" || fail "the log does not report a broken version"
before/bin/python -m zbridge restart --all --tls boss >restart.log 2>&1 || { cat restart.log; fail "zbridge restart failed with the previous code"; }
established r1 r2 && one_connection r1 && runs 0.2.1 || fail "a broken version disturbed r1"
[ "$(of MainPID zbridge)" = "$main" ] && is NRestarts zbridge "$starts" || fail "the unit was restarted"
ok "broken version installed: systemctl reload logs it, gateways restart with the previous code, r1's connection is the same"

install --wheels wheels --router
systemctl reload zbridge
zbridge restart --all --tls boss >restart.log 2>&1 || { cat restart.log; fail "zbridge restart failed after the repair"; }
established r1 r2 && one_connection r1 && runs 0.2.1 || fail "the repair disturbed r1"
ok "repaired by install.sh with the previous version; r1's connection is the same"
