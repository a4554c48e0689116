"""Instructions, memory and stack of exported controllers on an emulated Cortex-M7 or M4F.

    python -m benchmarks.embedded FOLDER.. [--cpu m7]      folders of `quadexp export-controller`, with prefix qx

Needed: gcc-arm-none-eabi and libnewlib-arm-none-eabi of the distribution, and the package unicorn. The recorded flight
is flown again in the emulator: its first steps, and those around the largest commands. An instruction is no cycle: a
Cortex-M7 makes between one half and two a cycle.
"""

from __future__ import annotations

import argparse
import bisect
import json
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
FLAGS = {
    "m7": ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb"),
    "m4": ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-mthumb"),
}
COMPILER = "arm-none-eabi-gcc"
LINK = ("-ffreestanding", "-nostartfiles", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
ROOTS = ("-Wl,-u,t_step,-u,t_reset,-e,t_step,--no-warn-rwx-segments", "-lm", "-lgcc", "-lc")
FLASH, RAM, SIZE = 0x00000000, 0x20000000, 0x100000
TOP = RAM + 2 * SIZE - 0x1000  # of the stack, which has a megabyte of its own
END = 0x300000  # where a call returns to
STEPS, AROUND = 4, 3  # that are flown from the start; and before each of the largest commands
BODY = 13


class Board:
    """An exported folder, linked for a processor, in memory. counts: of the blocks that ran, by address and size."""

    def __init__(self, folder: Path, cpu: str, scratch: Path) -> None:
        from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_HOOK_MEM_WRITE, UC_MODE_THUMB, Uc
        from unicorn.arm_const import UC_ARM_REG_C1_C0_2, UC_ARM_REG_FPEXC, UC_CPU_ARM_MAX

        self.about: dict[str, Any] = json.loads((folder / "model.json").read_text())
        self.real = np.dtype("<f8" if self.about["real"] == "double" else "<f4")
        self.program = scratch / "controller.elf"
        sources = [
            folder / name for name in ("controller.c", "model.c", "mpc.c", "node.c") if name in self.about["files"]
        ]
        files = [str(path) for path in (*sources, HERE / "embedded.c")]
        script = [
            "-T",
            str(HERE / "embedded.ld"),
            f"-I{folder}",
            "-O2",
            "-std=c11",
            "-ffp-contract=off",
            "-fno-math-errno",
        ]
        subprocess.run([COMPILER, *FLAGS[cpu], *script, *LINK, *files, *ROOTS, "-o", str(self.program)], check=True)
        self.places = {
            name: int(at, 16) for at, _, name in (line.split() for line in self._tool("nm") if line.count(" ") > 1)
        }
        listing = "\n".join(self._tool("objdump", "-d"))
        starts = re.finditer(r"^\s*([0-9a-f]+):\t[0-9a-f]{4}(?: [0-9a-f]{4})? *\t(?!\.word)", listing, re.MULTILINE)
        self._starts = [int(found[1], 16) for found in starts]
        self._machine = machine = Uc(UC_ARCH_ARM, UC_MODE_THUMB)
        machine.ctl_set_cpu_model(UC_CPU_ARM_MAX)  # the instructions are the same; the model of a Cortex lacks some
        machine.reg_write(UC_ARM_REG_C1_C0_2, machine.reg_read(UC_ARM_REG_C1_C0_2) | 0xF << 20)
        machine.reg_write(UC_ARM_REG_FPEXC, 0x40000000)
        machine.mem_map(FLASH, 4 * SIZE)
        machine.mem_map(RAM, 2 * SIZE)
        self._load()
        self.counts: dict[tuple[int, int], int] = {}
        self.lowest = TOP
        machine.hook_add(UC_HOOK_BLOCK, self._block)
        machine.hook_add(UC_HOOK_MEM_WRITE, self._write, begin=RAM + SIZE, end=TOP)

    def _load(self) -> None:
        """The loadable segments of the program."""
        data = self.program.read_bytes()
        (first,), (count,) = struct.unpack_from("<I", data, 28), struct.unpack_from("<H", data, 44)
        for i in range(count):
            kind, offset, address, _, size, *_ = struct.unpack_from("<8I", data, first + 32 * i)
            if kind == 1:
                self._machine.mem_write(address, data[offset : offset + size])

    def _tool(self, name: str, *flags: str) -> list[str]:
        command = [COMPILER.replace("gcc", name), *flags, str(self.program)]
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.splitlines()

    def _block(self, _machine: Any, address: int, size: int, _data: Any) -> None:
        key = address, size
        self.counts[key] = self.counts.get(key, 0) + 1

    def _write(self, _machine: Any, _access: int, address: int, _size: int, _value: int, _data: Any) -> None:
        self.lowest = min(self.lowest, address)

    def call(self, name: str) -> int:
        """Instructions of a call."""
        from unicorn.arm_const import UC_ARM_REG_LR, UC_ARM_REG_SP

        self.counts.clear()
        self._machine.reg_write(UC_ARM_REG_SP, TOP)
        self._machine.reg_write(UC_ARM_REG_LR, END | 1)
        self._machine.emu_start(self.places[name] | 1, END)
        starts, total = self._starts, 0
        for (address, size), times in self.counts.items():
            total += times * (bisect.bisect_left(starts, address + size) - bisect.bisect_left(starts, address))
        return total

    def tell(self, row: np.ndarray) -> None:
        """What a row of the vectors says to the controller; see plugins/vehicle/record.py."""
        n = self.about["rotors"]
        window = len(row) - BODY - 3 - 2 * n - 1
        state, reference, force, speed, _ = np.split(row, np.cumsum([BODY, window, 3, n]))
        for name, values in {"state": state, "window": reference, "force": force, "speed": speed}.items():
            self._machine.mem_write(self.places[f"t_{name}"], values.astype(self.real).tobytes())
        for name, values in {"read": force, "turning": speed}.items():
            self._machine.mem_write(self.places[f"t_{name}"], struct.pack("<i", int(not np.isnan(values[0]))))

    def apart(self, row: np.ndarray) -> float:
        """Largest difference of its command from the row's (N)."""
        n = self.about["rotors"]
        answer = bytes(self._machine.mem_read(self.places["t_command"], n * self.real.itemsize))
        return float(np.abs(np.frombuffer(answer, self.real).astype(float) - row[-1 - n : -1]).max())

    def sizes(self) -> dict[str, int]:
        """Bytes of flash and of RAM, the stack apart."""
        lines = (line.split() for line in self._tool("size", "-A"))
        found = {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[0].startswith(".")}
        data = found.get(".data", 0)
        return {"flash": found[".text"] + found.get(".rodata", 0) + data, "ram": data + found.get(".bss", 0)}


def measured(folder: Path, cpu: str) -> dict[str, Any]:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as scratch:
        board = Board(folder, cpu, Path(scratch))
        count = (
            BODY + 3 + 2 * board.about["rotors"] + 1,
            len(board.about["node_times"]),
            max(len(board.about["node_times"]) - 1, 1),
        )
        width = count[0] + BODY * count[1] + board.about["rotors"] * count[2] + 19
        rows = np.fromfile(folder / "vectors.bin", board.real).astype(float).reshape(-1, width)
        n = board.about["rotors"]
        largest = int(np.abs(rows[:, -1 - n : -1]).max(axis=1).argmax())
        steps, begun, apart = list[int](), list[int](), 0.0
        for first, last in ((0, STEPS), (max(largest - AROUND, 0), min(largest + AROUND, len(rows) - 1))):
            board.tell(rows[first])
            board.call("t_reset")
            for k in range(first, last + 1):
                board.tell(rows[k])
                (begun if k == first else steps).append(board.call("t_step"))
                apart = max(apart, board.apart(rows[k])) if first == 0 else apart
        numbers = {"step": int(np.median(steps[:STEPS])), "worst": max(steps), "first": max(begun)}
        return numbers | {"stack": TOP - board.lowest, "apart": apart, **board.sizes()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--cpu", choices=[*FLAGS], default="m7")
    given = parser.parse_args()
    if shutil.which(COMPILER) is None:
        sys.exit(f"skipped: no {COMPILER} here")
    if find_spec("unicorn") is None:
        sys.exit("skipped: the package unicorn is not installed")
    print(f"{'controller':28} {'step':>10} {'worst':>10} {'first':>10} {'flash':>8} {'ram':>8} {'stack':>7}  off (N)")
    for folder in given.folders:
        row = measured(folder, given.cpu)
        widths = {"step": 10, "worst": 10, "first": 10, "flash": 8, "ram": 8, "stack": 7}
        numbers = " ".join(f"{row[name]:{width},}" for name, width in widths.items())
        print(f"{folder.name:28} {numbers}  {row['apart']:.2g}", flush=True)


if __name__ == "__main__":
    main()
