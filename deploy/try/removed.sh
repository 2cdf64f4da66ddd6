# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: uninstalled, installed again, uninstalled with all that there was.

units() { systemctl list-unit-files 'zbridge*' | grep '^zbridge'; }
install --uninstall
! units || fail "units are left"
[ -f /etc/zbridge/bus/r1/key.pem ] && [ -n "$(find /var/lib/private/zbridge-recorder -name '*.mcap')" ] || fail "the configuration or the recordings are gone"
install --wheels wheels --router --recorder
robot r1 11001
established r1 r2 || fail "not as before"
ok "uninstalled, installed again: all runs as before"
install --uninstall --purge
! units || fail "units are left"
! getent passwd zbridge >/dev/null || fail "the user is left"
! ls -d /opt/zbridge /etc/zbridge /var/lib/zbridge /var/lib/private/zbridge-recorder /etc/systemd/system/zbridge* 2>/dev/null || fail "files are left"
ok "uninstalled with --purge: nothing is left"
