#!/usr/bin/env bash
# Runs on the host that deploy/try/host.sh booted: a router with certificates, robots, the ways in which a service ends.
# shellcheck source-path=SCRIPTDIR
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
cd /root

of() { systemctl show --value --property "$1" "$2"; }
within() { # SECONDS COMMAND...: wait for a condition
    local end=$((SECONDS + $1))
    shift
    until "$@" >/dev/null 2>&1; do [ $SECONDS -lt $end ] || return 1; sleep 0.2; done
}
said() { journalctl --quiet --unit "$1" --since "$2" --output cat | grep --quiet -- "$3"; }
now() { date '+%F %T.%6N'; }
established() { /opt/zbridge/bin/python /root/deploy/try/established.py "$@"; }
journal() { journalctl --unit 'zbridge*' --lines 40 --no-pager; }
trap '[ $? -eq 0 ] || journal' EXIT

bash deploy/install.sh --wheels wheels --router >install.log || { cat install.log; fail "install.sh"; }
[ "$(of ActiveState zbridge)" = inactive ] || fail "starts without a robot"
ok "installed; waits for certificates and robots"

zbridge certs init >/dev/null
zbridge certs issue hub --role router --host 127.0.0.1 >/dev/null
for name in r1 r2; do zbridge certs issue $name --role gateway --robot $name >/dev/null; done
zbridge certs issue wall --role viewer >/dev/null
zbridge certs bundle hub -o /etc/zbridge/router --force >/dev/null
for name in r1 r2; do
    zbridge certs bundle $name -o /etc/zbridge/bus/$name >/dev/null
    { zbridge init tcpudp --name $name | sed '/^\[bus\]/,/^stream/d'; cat /etc/zbridge/bus/$name/bus.toml; } >$name.toml
done
sed -i 's/11001/11011/' r2.toml
for port in 11001 11011; do zbridge simulate tcpudp --listen tcp://127.0.0.1:$port >/dev/null 2>&1 & done
cp r1.toml /etc/zbridge/robots/
bash deploy/install.sh --wheels wheels --router >install.log || { cat install.log; journal; fail "install.sh with a robot"; }
established r1 || fail "r1 is not established"
ok "the router and the gateway of r1 run, hardened, over mutual TLS"

cp r2.toml /etc/zbridge/robots/
systemctl reload zbridge
established r1 r2 || fail "r2 is not followed"
[ "$(of NRestarts zbridge)" = 0 ] || fail "restarted"
ok "a reload follows a file that came: $(of StatusText zbridge)"

pid=$(of MainPID zbridge)
grep -q '^CapBnd:\s*0*$' "/proc/$pid/status" || fail "capabilities are left"
grep -q '^NoNewPrivs:\s*1' "/proc/$pid/status" || fail "new privileges are allowed"
for file in /etc/zbridge/router/key.pem /root/certs/ca-key.pem /etc/shadow; do
    ! nsenter --target "$pid" --mount setpriv --reuid zbridge --regid zbridge --clear-groups cat $file >/dev/null 2>&1 || fail "gateways read $file"
done
! nsenter --target "$pid" --mount setpriv --reuid zbridge --regid zbridge --clear-groups touch /etc/zbridge/bus/r1/x 2>/dev/null || fail "gateways write /etc"
router=$(of MainPID zbridge-router)
case $(stat -c %u "/proc/$router") in 0 | "$(stat -c %u "/proc/$pid")") fail "the router's user" ;; esac
ok "gateways are without capabilities, and read neither the router's key nor the authority's; the router is another user"

since=$(now) began=$SECONDS
systemctl stop zbridge
[ $((SECONDS - began)) -lt 10 ] || fail "the stop takes $((SECONDS - began)) s"
said zbridge "$since" "r1 robot: gateway stopped" || fail "the gateways are not stopped in order"
[ "$(of Result zbridge)" = success ] || fail "the stop is called a failure"
systemctl start zbridge
established r1 r2 || fail "no start after a stop"
ok "stop and start"

since=$(now)
kill -KILL "$(of MainPID zbridge)"
within 10 said zbridge "$since" "r1 robot: gateway stopped" || fail "a dead supervisor's gateways go on"
established r1 r2 || fail "no start after a crash"
ok "the supervisor is killed: the gateways stop their robots, systemd starts anew"

since=$(now)
kill -STOP "$(of MainPID zbridge)"
within 30 said zbridge "$since" "Watchdog timeout" || fail "a hung supervisor is not found"
within 10 said zbridge "$since" "r1 robot: gateway stopped" || fail "a hung supervisor's gateways are not stopped in order"
established r1 r2 || fail "no start after a hang"
ok "the supervisor hangs: the watchdog finds it, the gateways stop their robots"

systemctl stop zbridge
mv /etc/zbridge/robots/r1.toml /etc/zbridge/single/
systemctl start zbridge zbridge@r1
established r1 r2 || fail "zbridge@r1"
echo "[robot" >/etc/zbridge/single/bad.toml
systemctl start zbridge@bad || true
is() { [ "$(of "$1" "$2")" = "$3" ]; }
within 10 is Result zbridge@bad exit-code || fail "a bad file is no failure"
sleep 3
[ "$(of NRestarts zbridge@bad)" = 0 ] || fail "a bad file is tried again and again"
ok "a unit for one robot; a bad file is not tried again"

systemctl restart zbridge-router
established r1 r2 || fail "the router's restart"
ok "the router restarts: the gateways come back"

has_tls() { zbridge "$1" --help 2>/dev/null | grep --quiet -- --tls; }
if has_tls record && /opt/zbridge/bin/python -c 'import mcap' 2>/dev/null; then
    zbridge certs issue box --role recorder >/dev/null
    zbridge certs bundle box -o /etc/zbridge/recorder --force >/dev/null
    zbridge certs bundle hub -o /etc/zbridge/router --force >/dev/null
    systemctl restart zbridge-router
    bash deploy/install.sh --wheels wheels --router --recorder >/dev/null || fail "--recorder"
    recorded() { find /var/lib/private/zbridge-recorder -name '*.mcap' -size +20k | grep --quiet .; }
    within 20 recorded || fail "nothing is recorded"
    ok "the recorder records"
else
    echo "not tried: the recorder (this version's zbridge record has no --tls, or its extra is not among the wheels)"
fi
if has_tls health; then
    zbridge certs bundle wall -o wall >/dev/null
    zbridge health --connect tls/127.0.0.1:7447 --tls wall || fail "zbridge health"
    ok "zbridge health"
else
    echo "not tried: zbridge health (this version's has no --tls)"
fi

bash deploy/install.sh --uninstall --purge >/dev/null || fail "--uninstall"
! systemctl list-unit-files 'zbridge*' | grep -q '^zbridge' || fail "units are left"
! getent passwd zbridge >/dev/null || fail "the user is left"
! ls -d /opt/zbridge /etc/zbridge /var/lib/zbridge 2>/dev/null || fail "folders are left"
ok "uninstalled"
