# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: from a bare host to two robots; the permissions of the services.

install --wheels "$work/wheels" --router
[ "$(of ActiveState zbridge)" = inactive ] || fail "zbridge started without a robot"
ok "installed, not started: no certificates and no robots yet"

zbridge certs init >/dev/null
issue() { zbridge certs issue "$@" >/dev/null; }
issue hub --role router --host 127.0.0.1
for name in r1 r2; do issue $name --role gateway --robot $name; done
issue wall --role viewer
issue ann --role operator
issue boss --role supervisor
issue box --role recorder
for name in wall ann boss; do zbridge certs bundle $name -o $name >/dev/null; done
zbridge certs bundle hub -o /etc/zbridge/router --force >/dev/null
zbridge certs bundle box -o /etc/zbridge/recorder --force >/dev/null
port=9100
for name in r1 r2; do
    zbridge certs bundle $name -o /etc/zbridge/bus/$name >/dev/null
    port=$((port + 1))
    {
        zbridge init tcpudp --name $name | sed -e '/^\[bus\]/,/^stream/d'
        cat /etc/zbridge/bus/$name/bus.toml
        printf '[metrics]\nlisten = "127.0.0.1:%d"\n' $port
    } >$name.toml
done
sed -i 's/11001/11011/' r2.toml
robot r1 11001
start_of r2 zbridge simulate tcpudp --listen tcp://127.0.0.1:11011
cp r1.toml /etc/zbridge/robots/
install --wheels "$work/wheels" --router
established r1 || fail "r1 is not established"
ok "the router and the gateway of r1 run over mutual TLS"

main=$(of MainPID zbridge)
install --wheels "$work/wheels" --router
! grep "wrote" install.log || fail "the second run wrote files"
[ "$(of MainPID zbridge)" = "$main" ] && one_connection r1 || fail "the second run disturbed the running services"
ok "second run of install.sh: wrote nothing, left the running services alone"

cp r2.toml /etc/zbridge/robots/
systemctl reload zbridge
established r1 r2 || fail "a reload did not start r2"
within 10 is StatusText zbridge "2 robots, 2 established" || fail "status: $(of StatusText zbridge)"
is NRestarts zbridge 0 && one_connection r1 || fail "the reload disturbed r1"
ok "a reload starts the gateway of a new file: $(of StatusText zbridge)"

install --wheels "$work/wheels" --router --recorder
within 20 is ActiveState zbridge-recorder active || fail "the recorder did not start"
for unit in zbridge zbridge-router zbridge-recorder; do
    level=$(systemd-analyze security --threshold=30 $unit.service 2>&1 | tail -n 1) || fail "$level"
    pid=$(of MainPID $unit)
    grep -q '^CapBnd:\s*0*$' "/proc/$pid/status" && grep -q '^NoNewPrivs:\s*1' "/proc/$pid/status" && grep -q '^Seccomp:\s*2' "/proc/$pid/status" || fail "$unit has capabilities, or its system calls are not filtered"
    ok "$unit at run time: exposure $(grep -o "[0-9]\.[0-9]" <<<"$level"), no capabilities, no new privileges, system calls filtered"
done

as() { # UNIT COMMAND...: runs a command in the unit's file system, as its user
    local pid
    pid=$(of MainPID "$1")
    nsenter --target "$pid" --mount setpriv --reuid "$(stat -c %u "/proc/$pid")" --regid "$(stat -c %g "/proc/$pid")" --clear-groups "${@:2}" >/dev/null 2>&1
}
user() { stat -c %u "/proc/$(of MainPID "$1")"; }
as zbridge cat /etc/zbridge/bus/r1/key.pem || fail "the gateways cannot read their own key"
for unit in router recorder; do
    key=/run/credentials/zbridge-$unit.service/key.pem
    as zbridge-$unit cat "$key" || fail "the $unit cannot read its own key"
    [ "$(user zbridge-$unit)" -ge 61184 ] && [ "$(user zbridge-$unit)" -le 65519 ] || fail "the $unit's user is not a dynamic user"
    [ "$(stat -c %a "$key")" = 400 ] || fail "the mode of $key"
done
[ "$(user zbridge-router)" != "$(user zbridge-recorder)" ] || fail "router and recorder have the same user"
[ "$(stat -c '%U %a' /etc/zbridge/bus/r1/key.pem)" = "zbridge 600" ] || fail "the mode of a gateway's key"
[ "$(stat -c '%u %a' /var/lib/private)" = "0 700" ] && [ "$(stat -c %u /var/lib/private/zbridge-recorder)" = "$(user zbridge-recorder)" ] || fail "the recorder's folder"
refused() { # UNIT FILE...
    local file
    for file in "${@:2}"; do ! as "$1" cat "$file" || fail "$1 can read $file"; done
}
refused zbridge /etc/zbridge/router/key.pem /etc/zbridge/recorder/key.pem /run/credentials/zbridge-router.service/key.pem "$work/certs/ca-key.pem" /etc/shadow
refused zbridge-router /etc/zbridge/bus/r1/key.pem /etc/zbridge/router/key.pem /run/credentials/zbridge-recorder.service/key.pem "$work/certs/ca-key.pem"
refused zbridge-recorder /etc/zbridge/bus/r1/key.pem /etc/zbridge/recorder/key.pem /run/credentials/zbridge-router.service/key.pem "$work/certs/ca-key.pem"
! setpriv --reuid nobody --regid nogroup --clear-groups cat /etc/zbridge/bus/r1/key.pem 2>/dev/null || fail "everybody can read the gateways' key"
! as zbridge touch /etc/zbridge/bus/r1/x || fail "gateways can write to /etc"
ok "each service can read its own key and no other; router and recorder have dynamic users (DynamicUser), and their keys as credentials"
