#!/bin/sh
# The first process of a container: runs zbridge, and outlives it. When the first process ends, the kernel kills all others at once. So this one stays
# while the gateway lives that a restart handed the robot to, and after a supervisor that died until its gateways have stopped their robots, for 5 s at most.
child='' ended='' stopping=''
tell() { # all that is left, once zbridge has ended; zbridge before
    if [ -n "$ended" ]; then kill "-$1" -1 2>/dev/null; elif [ -n "$child" ]; then kill "-$1" "$child"; fi
}
trap 'stopping=yes; tell TERM' TERM INT
trap 'tell HUP' HUP
trap 'tell USR2' USR2

exec 3<&0 # in the background a shell gives nothing to read
/opt/zbridge/bin/zbridge "$@" <&3 3<&- &
child=$!
[ -z "$stopping" ] || tell TERM

code=0
while # a signal interrupts the wait
    wait "$child"
    code=$?
    kill -0 "$child" 2>/dev/null
do :; done
ended=yes

others() { # whether another process lives
    for stat in /proc/[0-9]*/stat; do
        read -r state 2>/dev/null <"$stat" || continue
        case $state in "$$ "* | *") Z "*) ;; *) return 0 ;; esac
    done
    return 1
}
left=50
while [ $left -gt 0 ] && others; do
    sleep 0.1
    [ $code -eq 0 ] || left=$((left - 1))
done
exit $code
