#!/usr/bin/env bash
# Runs the tests marked `socketcan` on interfaces made for them.
#
#   tests/socketcan_vm.sh                       as root, on a kernel that has vcan, vxcan and netem
#   tests/socketcan_vm.sh GUEST [OPTION...]     inside a throw-away guest: GUEST is a program that
#                                               runs `GUEST [OPTION...] -- COMMAND...` as root in a
#                                               guest that sees this folder and the interpreter
#
# PYTHON names the interpreter (default: python3); it needs flasher with its `dev` extra.
# vcan0: no limits. vx0/vx1: a pair with the speed of a 250 kbit/s bus and a transmit queue of ten
# frames, which refuses the eleventh (ENOBUFS) as a real adapter does.
set -euo pipefail
cd "$(dirname "$0")/.."
export PYTHON=${PYTHON:-$(command -v python3)}

if [ $# -gt 0 ] && [ "$1" != --here ]; then
    exec "$@" -- env PYTHON="$PYTHON" bash tests/socketcan_vm.sh --here
fi

ip link show vcan0 >/dev/null 2>&1 || ip link add dev vcan0 type vcan
ip link set vcan0 up
ip link show vx0 >/dev/null 2>&1 || ip link add dev vx0 type vxcan peer name vx1
for side in vx0 vx1; do
    ip link set "$side" up
    tc qdisc replace dev "$side" root netem rate 250kbit limit 10
done
code=0
"$PYTHON" -m pytest -n 0 -m socketcan -p no:cacheprovider --color=no -rsP --durations=0 \
    tests/end_to_end/test_socketcan.py || code=$?
tc -s qdisc show dev vx0
exit "$code"
