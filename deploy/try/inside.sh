#!/usr/bin/env bash
# Tests a router with certificates and robots on the host that deploy/try/host.sh booted. Usage: inside.sh FOLDER PART...
# shellcheck source-path=SCRIPTDIR disable=SC2015
source "$(dirname "${BASH_SOURCE[0]}")/common.sh"
cd "$work"

of() { systemctl show --value --property "$1" "$2"; }
is() { [ "$(of "$1" "$2")" = "$3" ]; }
said() { journalctl --quiet --unit "$1" --since "$2" --output cat | grep -- "$3" >/dev/null; }
now() { date '+%F %T.%6N'; }
python() { /opt/zbridge/bin/python "$@"; }
established() { python "$root/deploy/try/established.py" "$work/wall" "$@"; }
install() { bash "$root/deploy/install.sh" "$@" >"$work/install.log" 2>&1 || { cat "$work/install.log"; fail "install.sh $*"; }; }
over() {
    [ "$1" -eq 0 ] || { journalctl --unit 'zbridge*' --no-pager | grep --invert-match 'viewer.wall' | tail -n 40; tail -n 5 "$work"/*.account; }
    kill "${robots[@]}" 2>/dev/null || true
}
declare -A robots=()
trap 'over $?' EXIT

robot() { # NAME PORT: restarts a fragile robot, which serves one connection per start, as legacy ones do
    start_of "$1" /opt/zbridge/bin/python "$root/deploy/try/robot.py" "$2" "$work/$1.account"
}
start_of() { # NAME COMMAND...: starts a command; not a function, which would run in a process of its own
    end_of "$1"
    "${@:2}" >/dev/null 2>&1 &
    robots[$1]=$!
}
end_of() { # NAME
    [ -z "${robots[$1]:-}" ] || { kill "${robots[$1]}" 2>/dev/null || true; wait "${robots[$1]}" 2>/dev/null || true; }
}
one_connection() { # NAME: fails if the robot reported anything since its start, except faults caused by its own lateness
    ! grep -e '^violation' -e 'second connection' -e 'ended' "$work/$1.account" | grep -v '(this process'
}
driven() { # LIMIT_S COMMAND...: drives r1 while the command runs; r1 must stop within LIMIT_S; sets rest to the time
    rest=$(python "$root/deploy/try/driven.py" "$work/ann" r1 "$work/r1.account" "$@" 2>"$work/driven.log") || { cat "$work/driven.log"; fail "$rest"; }
}
gateway() { pgrep --exact "zb $1" | head -n 1; }
for part in "${@:2}"; do
    echo "-- $part"
    # shellcheck disable=SC1090
    source "$root/deploy/try/$part.sh" "$work"
done
