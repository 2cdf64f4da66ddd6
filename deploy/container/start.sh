#!/bin/sh
# The first process of a container: runs zbridge, and outlives it. When the first process ends, the kernel kills all others at once. This process
# therefore waits for the successor of a restarted gateway, and, after the supervisor died, up to 5 s until the gateways have stopped their robots.
child='' ended='' stopping=''
signal() { # SIGNAL: signals zbridge, or, once it has ended, all remaining processes
    if [ -n "$ended" ]; then kill "-$1" -1 2>/dev/null; elif [ -n "$child" ]; then kill "-$1" "$child"; fi
}
trap 'stopping=yes; signal TERM' TERM INT
trap 'signal HUP' HUP
trap 'signal USR2' USR2

exec 3<&0 # a background process of a shell gets /dev/null as its standard input
/opt/zbridge/bin/zbridge "$@" <&3 3<&- &
child=$!
[ -z "$stopping" ] || signal TERM

code=0
while # a signal interrupts the wait
    wait "$child"
    code=$?
    kill -0 "$child" 2>/dev/null
do :; done
ended=yes

others() { # succeeds if another process lives
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
