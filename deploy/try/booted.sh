# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: the host has booted again, without any intervention.

for unit in zbridge-router zbridge zbridge-recorder; do
    within 30 is ActiveState $unit active || fail "$unit did not start at boot"
    is NRestarts $unit 0 || fail "$unit was started more than once"
done
robot r1 11001
start_of r2 zbridge simulate tcpudp --listen tcp://127.0.0.1:11011
established r1 r2 || fail "the robots are not established after a boot"
ok "the host booted again: router, gateways and recorder run, r1 and r2 are established"

install --wheels wheels --router --recorder --serial
systemctl restart zbridge
robot r1 11001
established r1 r2 || fail "the robots are not established with --serial"
level=$(systemd-analyze security --threshold=30 zbridge.service 2>&1 | tail -n 1) || fail "$level"
of DeviceAllow zbridge | grep char-ttyUSB >/dev/null || fail "--serial does not allow serial lines"
ok "install.sh --serial: exposure $(grep -o "[0-9]\.[0-9]" <<<"$level"), the gateways run"
