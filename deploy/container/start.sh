#!/bin/sh
# The first process of a container: runs zbridge, and outlives it. When the first process ends, the kernel kills all others at once; so this one waits
# until the gateways of a supervisor that died have stopped their robots, for 5 s at most.
/opt/zbridge/bin/zbridge "$@" &
child=$!
trap 'kill -TERM $child' TERM INT
trap 'kill -HUP $child' HUP
trap 'kill -USR2 $child' USR2

code=0
while # a signal interrupts the wait
    wait $child
    code=$?
    kill -0 $child 2>/dev/null
do :; done

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
    left=$((left - 1))
done
exit $code
