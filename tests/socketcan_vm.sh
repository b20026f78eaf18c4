#!/usr/bin/env bash
# Tries flasher on interfaces of Linux: the tests marked `socketcan`, each printed with its result.
#
#   tests/socketcan_vm.sh [OWN OPTION...]                          here, as root
#   tests/socketcan_vm.sh [OWN OPTION...] GUEST [GUEST'S OPTION...]  inside a throw-away guest
#
# GUEST is a program that runs `GUEST [OPTION...] -- COMMAND...` as root in a guest whose kernel has
# vcan, vxcan and netem, and which sees this folder and the interpreter (tests write nothing here).
# PYTHON names the interpreter (default: python3); it needs flasher with its `dev` extra.
#
#   --sja1000 NAME,NAME     two SJA1000 controllers on one bus, for example of QEMU:
#                           -object can-bus,id=b -device kvaser_pci,canbus=b -device kvaser_pci,canbus=b
#   --candlelight PROGRAM   a program that emulates two candleLight adapters on one bus, through the
#                           kernel's own driver (modules vhci-hcd and gs_usb): `PROGRAM FIFO` makes two
#                           interfaces appear, whose USB serial numbers end with 0 and 1, and reads
#                           lines from the named pipe: `unplug N`, `plug N`, `short MS` (every frame
#                           fails for so long), `lose K` (every Kth frame is missed, 0 none)
#   --only WORDS            as pytest's -k
#
# These interfaces are taken down, set up anew and sent noise: never name those of a real bus. Without
# an option its tests are skipped. Tests of times want a guest whose time does not depend on the load
# of its host (QEMU: -icount); what is read from disk takes long there, so each command is forked.
#
# vcan0: no limits. vx0/vx1: a pair with the speed of a 250 kbit/s bus and a transmit queue of ten
# frames, which refuses the eleventh (ENOBUFS) as a real adapter does.
set -euo pipefail
cd "$(dirname "$0")/.."
export PYTHON=${PYTHON:-$(command -v python3)}

own=() here='' candlelight='' only=''
while [ $# -gt 0 ]; do
    case $1 in
        --here) here=1; shift; continue;;
        --sja1000) export FLASHER_SJA1000=$2;;
        --candlelight) candlelight=$(realpath "$2");;
        --only) only=$2;;
        -*) sed -n '2,27p' "$0" >&2; exit 2;;
        *) break;;
    esac
    own+=("$1" "$2"); shift 2
done
if [ $# -gt 0 ]; then
    code=0
    "$@" -- env PYTHON="$PYTHON" bash tests/socketcan_vm.sh --here ${own[@]+"${own[@]}"} || code=$?
    echo "$SECONDS s in all, with the start of the guest; exit code $code"
    exit "$code"
fi

ip link show vcan0 >/dev/null 2>&1 || ip link add dev vcan0 type vcan
ip link set vcan0 up
ip link show vx0 >/dev/null 2>&1 || ip link add dev vx0 type vxcan peer name vx1
for side in vx0 vx1; do
    ip link set "$side" up
    tc qdisc replace dev "$side" root netem rate 250kbit limit 10
done
folder=$(mktemp -d -p /run)
trap 'kill $(jobs -p) 2>/dev/null || true; rm -r "$folder"' EXIT
if [ -n "$here" ]; then # from memory: a guest whose time counts instructions runs ahead while it reads
    mkdir "$folder/bin" "$folder/lib" "$folder/tmp"
    for tool in sh ip tc candump cansend cangen canplayer log2asc isotpsend isotprecv; do
        program=$(command -v $tool) || continue
        cp -L "$program" "$folder/bin"
        ldd "$program" | awk '$3 ~ "^/" { print $3 }' | xargs -r cp -L -t "$folder/lib" -u
    done
    loader=$(realpath /lib64/ld-linux-x86-64.so.2)
    cp "$loader" "$folder/lib" && mount --bind "$folder/lib/${loader##*/}" "$loader"
    cp -rL /etc/iproute2 "$folder" && mount --bind "$folder/iproute2" /etc/iproute2
    export PATH=$folder/bin:$PATH LD_LIBRARY_PATH=$folder/lib TMPDIR=$folder/tmp
fi
if [ -n "$candlelight" ]; then
    export FLASHER_CANDLELIGHT=$folder/control
    mkfifo "$FLASHER_CANDLELIGHT"
    # First of all processes: hardware does not wait for the CPU.
    nice -n -20 "$candlelight" "$FLASHER_CANDLELIGHT" 2>"$folder/candlelight.log" &
fi
"$PYTHON" -m pytest -n 0 -m kernel -k "$only" -v -rsP --color=no --tb=short --durations=5 \
    -p no:cacheprovider -p tests.end_to_end.forks -p no:hypothesispytest -p no:anyio \
    tests/end_to_end/test_{socketcan,candlelight,sja1000,printed_commands,can_tools}.py
[ -n "$here" ] || echo "$SECONDS s in all"
