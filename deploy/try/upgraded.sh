# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: another version is installed under way, then a broken one.

runs() { # VERSION: whether the gateways of r1 and r2 are of the version that says so
    local port
    for port in 9101 9102; do page "http://127.0.0.1:$port/metrics" | grep "zbridge=$1" >/dev/null || return 1; done
}
taken_over() { said zbridge "$since" "the installed code has taken over"; }

! runs 0.1.1 || fail "the version of before is the next one"
main=$(of MainPID zbridge) starts=$(of NRestarts zbridge) since=$(now)
cp later-0.1.1/*.whl wheels/
install --wheels wheels --router
grep --quiet "installed zbridge==0.1.1" install.log || fail "0.1.1 is not installed"
! runs 0.1.1 && one_connection r1 || fail "install.sh disturbs what runs"
systemctl reload zbridge
within 60 taken_over || fail "the supervisor goes on with the code of before"
driven 30 zbridge restart --all --tls boss
within 10 runs 0.1.1 || fail "the gateways are of the version of before"
[ "$(of MainPID zbridge)" = "$main" ] && is NRestarts zbridge "$starts" || fail "the unit was restarted"
established r1 r2 && one_connection r1 || fail "the robot's connection is lost"
ok "upgraded under way (install.sh, systemctl reload, zbridge restart --all): $rest, the unit and r1's connection are the same"

cp -a /opt/zbridge before # who asks for the restart is elsewhere: his version is not broken
since=$(now)
install --wheels later-0.1.2/zbridge-0.1.2-py3-none-any.whl --extras "" --router
systemctl reload zbridge
within 60 said zbridge "$since" "the old code continues\|continues with the old code" || fail "nothing is said of a broken version"
before/bin/python -m zbridge restart --all --tls boss >restart.log 2>&1 || { cat restart.log; fail "no restart with the code of before"; }
established r1 r2 && one_connection r1 && runs 0.1.1 || fail "a broken version disturbs r1"
[ "$(of MainPID zbridge)" = "$main" ] && is NRestarts zbridge "$starts" || fail "the unit was restarted"
ok "a broken version is installed: systemctl reload logs it, gateways are restarted with the code of before, r1's connection is the same"

install --wheels wheels --router
systemctl reload zbridge
zbridge restart --all --tls boss >restart.log 2>&1 || { cat restart.log; fail "no restart after the repair"; }
established r1 r2 && one_connection r1 && runs 0.1.1 || fail "the repair disturbs r1"
ok "repaired by install.sh with the version of before; r1's connection is the same"
