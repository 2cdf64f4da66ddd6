# shellcheck shell=bash source-path=SCRIPTDIR disable=SC2154,SC2015
# A part of inside.sh: uninstall, install again, uninstall with --purge.

units() { systemctl list-unit-files 'zbridge*' | grep '^zbridge'; }
install --uninstall
! units || fail "--uninstall left units"
[ -f /etc/zbridge/bus/r1/key.pem ] && [ -n "$(find /var/lib/private/zbridge-recorder -name '*.mcap')" ] || fail "--uninstall removed the configuration or the recordings"
install --wheels wheels --router --recorder
robot r1 11001
established r1 r2 || fail "the robots are not established after a new installation"
ok "uninstalled and installed again: everything runs as before"
install --uninstall --purge
! units || fail "--purge left units"
! getent passwd zbridge >/dev/null || fail "--purge left the user"
! ls -d /opt/zbridge /etc/zbridge /var/lib/zbridge /var/lib/private/zbridge-recorder /etc/systemd/system/zbridge* 2>/dev/null || fail "--purge left files"
ok "uninstalled with --purge: nothing remains"
