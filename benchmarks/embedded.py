"""Instructions, memory and stack of exported controllers on an emulated Cortex-M7 or M4F.

    python -m benchmarks.embedded [--model models/gp]      what docs/vehicle.md has in its table
    python -m benchmarks.embedded FOLDER.. [--cpu m7]      folders of `quadexp export-controller`, with prefix qx

Needed: gcc-arm-none-eabi and libnewlib-arm-none-eabi of the distribution, and the package unicorn. Two linear MPCs of
the same horizon stand beside, where they are there: the code that the package tinympc generates (it needs
libstdc++-arm-none-eabi-newlib), and DAQP, from its source distribution (--daqp). They are about hover, know neither
attitude beyond small angles nor air, and compute no model in flight. The recorded flight
is flown again in the emulator: its first steps, and those around the largest commands. An instruction is no cycle: a
Cortex-M7 makes between one half and two a cycle.
"""

from __future__ import annotations

import argparse
import bisect
import contextlib
import json
import math
import re
import shutil
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from quadexp.parts.compose import compose
from quadexp.plugins.vehicle.export import export_controller

HERE = Path(__file__).parent
FLAGS = {
    "m7": ("-mcpu=cortex-m7", "-mfpu=fpv5-d16", "-mfloat-abi=hard", "-mthumb"),
    "m4": ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", "-mfloat-abi=hard", "-mthumb"),
}
TOOLS = "arm-none-eabi-"
LINK = ("-ffreestanding", "-nostartfiles", "-ffunction-sections", "-fdata-sections", "-Wl,--gc-sections")
ROOTS = ("-Wl,-u,t_step,-u,t_reset,-e,t_step,--no-warn-rwx-segments", "-lm", "-lgcc", "-lc")
FLASH, RAM, SIZE = 0x00000000, 0x20000000, 0x100000
TOP = RAM + 2 * SIZE - 0x1000  # of the stack, which has a megabyte of its own
END = 0x300000  # where a call returns to
STEPS, AROUND = 4, 3  # that are flown from the start; and before each of the largest commands
BODY = 13
NODES, NODE = 10, 0.1  # of the published horizon, and their length (s)
AWAY = 0.1, 5.0  # m, from which linear MPCs begin: no rotor is at its limits, and several are
PATH = ("trajectory=lemniscate", "trajectory.speed=12")  # where rotors are at their limits
CONTROLLERS = {
    "nominal_mpc": ("controller=nominal_mpc",),
    "linear_drag_mpc": ("controller=linear_drag_mpc",),
    "gp_mpc": ("controller=gp_mpc",),
    "geometric l1": ("controller=geometric", "adaptive=l1"),
}


def linked(folder: Path, cpu: str, scratch: Path) -> Path:
    """The program of an exported folder."""
    about = json.loads((folder / "model.json").read_text())
    names = [name for name in ("controller.c", "model.c", "mpc.c", "node.c") if name in about["files"]]
    files = [*(folder / name for name in names), HERE / "embedded.c"]
    return compiled("gcc", cpu, ["-std=c11", "-ffp-contract=off", "-fno-math-errno", f"-I{folder}"], files, scratch)


def compiled(compiler: str, cpu: str, flags: Sequence[str], files: Sequence[Path], scratch: Path) -> Path:
    """Sources for a processor, linked as embedded.ld says."""
    program = scratch / "controller.elf"
    command = [f"{TOOLS}{compiler}", *FLAGS[cpu], "-T", str(HERE / "embedded.ld"), "-O2", *flags, *LINK]
    subprocess.run([*command, *map(str, files), *ROOTS, "-o", str(program)], check=True)
    return program


class Board:
    """A program in the memory of a processor. counts: of the blocks that ran, by address and size."""

    def __init__(self, program: Path) -> None:
        from unicorn import UC_ARCH_ARM, UC_HOOK_BLOCK, UC_HOOK_MEM_WRITE, UC_MODE_THUMB, Uc
        from unicorn.arm_const import UC_ARM_REG_C1_C0_2, UC_ARM_REG_FPEXC, UC_CPU_ARM_MAX

        self.program = program
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
        command = [f"{TOOLS}{name}", *flags, str(self.program)]
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

    def write(self, name: str, content: bytes) -> None:
        """What a variable of the program holds."""
        self._machine.mem_write(self.places[name], content)

    def read(self, name: str, count: int) -> bytes:
        """Likewise, so many bytes."""
        return bytes(self._machine.mem_read(self.places[name], count))

    def sizes(self) -> dict[str, int]:
        """Bytes of flash and of RAM, the stack apart."""
        lines = (line.split() for line in self._tool("size", "-A"))
        found = {words[0]: int(words[1]) for words in lines if len(words) > 1 and words[0].startswith(".")}
        data = found.get(".data", 0)
        return {"flash": found[".text"] + found.get(".rodata", 0) + data, "ram": data + found.get(".bss", 0)}


class InputArrays:
    """An exported folder's recorded flight, given to its program row by row."""

    def __init__(self, folder: Path, board: Board) -> None:
        about: dict[str, Any] = json.loads((folder / "model.json").read_text())
        self.board, self.real = board, np.dtype("<f8" if about["real"] == "double" else "<f4")
        self.rotors, nodes = about["rotors"], len(about["node_times"])
        width = BODY + BODY * nodes + self.rotors * max(nodes - 1, 1) + 19 + 3 + 2 * self.rotors + 1
        self.rows = np.fromfile(folder / "vectors.bin", self.real).astype(float).reshape(-1, width)
        self.commands = self.rows[:, -1 - self.rotors : -1]

    def set_measurement(self, k: int) -> None:
        """See plugins/vehicle/record.py."""
        n, row = self.rotors, self.rows[k]
        window = len(row) - BODY - 3 - 2 * n - 1
        state, reference, force, speed, _ = np.split(row, np.cumsum([BODY, window, 3, n]))
        for name, values in {"state": state, "window": reference, "force": force, "speed": speed}.items():
            self.board.write(f"t_{name}", values.astype(self.real).tobytes())
        for name, values in {"read": force, "turning": speed}.items():
            self.board.write(f"t_{name}", struct.pack("<i", int(not np.isnan(values[0]))))

    def apart(self, k: int) -> float:
        """Largest difference of the program's command from the row's (N)."""
        answer = np.frombuffer(self.board.read("t_command", self.rotors * self.real.itemsize), self.real)
        return float(np.abs(answer.astype(float) - self.commands[k]).max())


def measured(folder: Path, cpu: str) -> dict[str, Any]:
    """A row of the table."""
    with tempfile.TemporaryDirectory() as scratch:
        board = Board(linked(folder, cpu, Path(scratch)))
        told = InputArrays(folder, board)
        largest = int(np.abs(told.commands).max(axis=1).argmax())
        steps, begun, apart = list[int](), list[int](), 0.0
        for first, last in ((0, STEPS), (max(largest - AROUND, 0), min(largest + AROUND, len(told.rows) - 1))):
            told.set_measurement(first)
            board.call("t_reset")
            for k in range(first, last + 1):
                told.set_measurement(k)
                (begun if k == first else steps).append(board.call("t_step"))
                apart = max(apart, told.apart(k)) if first == 0 else apart
        numbers = {"step": int(np.median(steps[:STEPS])), "worst": max(steps), "first": max(begun)}
        return numbers | {"stack": TOP - board.lowest, "apart": apart, **board.sizes()}


class Linear(NamedTuple):
    """A linear MPC about hover: x_next = A x + B u, x: position, small angles, velocity, body rates (12,); u: thrusts
    beyond hover (n,) (N), low <= u <= high; cost x' Q x + u' R u over NODES, in double."""

    A: np.ndarray
    B: np.ndarray
    Q: np.ndarray
    R: np.ndarray
    low: float
    high: float


def linear_mpc() -> Linear:
    """That of the bench's vehicle."""
    from scipy.linalg import expm

    vehicle = compose(["trajectory=hover"]).vehicle
    A, B = hover_model(vehicle)
    n, m = B.shape
    both = expm(NODE * np.block([[A, B], [np.zeros((m, n + m))]]))
    weights = np.diag(np.repeat([100.0, 10.0, 1.0, 0.1], 3))
    hover = vehicle.hover_thrust
    return Linear(
        both[:n, :n], both[:n, n:], weights, 0.1 * np.eye(m), vehicle.thrust_min - hover, vehicle.thrust_max - hover
    )


def row_of(board: Board, mpc: Linear, command_of: Callable[[np.ndarray], np.ndarray] | None = None) -> dict[str, Any]:
    """A row of a linear MPC: the first call solves from AWAY, the others go on along its prediction. command_of: what
    is to be answered; None: unknown."""
    counts, apart = list[int](), 0.0
    for away in AWAY:
        board.call("t_reset")
        x = away * np.eye(len(mpc.A))[0]
        for _ in range(STEPS + 1):
            board.write("t_state", x.astype("<f8").tobytes())
            counts.append(board.call("t_step"))
            command = np.frombuffer(board.read("t_command", 8 * mpc.B.shape[1]), "<f8")
            apart = max(apart, np.abs(command - command_of(x)).max()) if command_of else math.nan
            x = mpc.A @ x + mpc.B @ command
        if away == AWAY[0]:
            used = board.sizes()
            used["ram"] += struct.unpack("<i", board.read("t_heap", 4))[0]
    row = {"step": int(np.median(counts[1 : STEPS + 1])), "worst": max(counts), "first": counts[0]}
    return row | {"stack": TOP - board.lowest, "apart": apart, **used}


def tinympc(cpu: str) -> dict[str, Any]:
    """A row of the code that TinyMPC generates; its iterations end at a tolerance of 1e-3."""
    import tinympc as package

    mpc = linear_mpc()
    n, m = mpc.B.shape
    solver = package.TinyMPC()
    solver.setup(mpc.A, mpc.B, mpc.Q, mpc.R, NODES, rho=1.0, max_iter=100, abs_pri_tol=1e-3, abs_dua_tol=1e-3)
    limits = np.full(m, mpc.low), np.full(m, mpc.high)
    solver.set_bound_constraints(np.full(n, -1e17), np.full(n, 1e17), *limits)
    solver.set_x0(AWAY[0] * np.eye(n)[0])
    with tempfile.TemporaryDirectory() as scratch:
        made = Path(scratch) / "tinympc"
        with contextlib.suppress(subprocess.CalledProcessError):  # it then builds a Python module, which is not needed
            solver.codegen(str(made))
        sources = [HERE / "embedded_tinympc.cpp", HERE / "embedded_heap.c", made / "src" / "tiny_data.cpp"]
        sources += [made / "tinympc" / name for name in ("admm.cpp", "rho_benchmark.cpp")]
        flags = ["-std=c++17", "-DNDEBUG", "-fno-exceptions", "-fno-rtti", "-fno-threadsafe-statics"]
        flags += [f"-I{made}", f"-I{made / 'include'}", f"-I{made / 'include' / 'Eigen'}"]
        return row_of(Board(compiled("g++", cpu, flags, sources, Path(scratch))), mpc)


def daqp(cpu: str, source: Path) -> dict[str, Any]:
    """A row of DAQP: the same MPC without its states, a QP in the inputs of all nodes, solved to its own tolerance.

    source: folder csrc of its source distribution."""
    from scipy.optimize import lsq_linear

    mpc = linear_mpc()
    H, F = condensed(mpc)
    root = np.linalg.cholesky(H)

    def command(x: np.ndarray) -> np.ndarray:
        right = -np.linalg.solve(root, F @ x)
        answer: np.ndarray = lsq_linear(root.T, right, (mpc.low, mpc.high), tol=1e-14).x
        return answer[: mpc.B.shape[1]]

    with tempfile.TemporaryDirectory() as scratch:
        rows = [f"{{{', '.join(map(repr, row.tolist()))}}}" for row in F]
        text = f"#define COUNT {len(H)}\n#define LOW {mpc.low!r}\n#define HIGH {mpc.high!r}\n"
        text += f"static double H[] = {{{', '.join(map(repr, H.ravel().tolist()))}}};\n"
        text += f"static const double F[COUNT][{len(mpc.A)}] = {{{', '.join(rows)}}};\n"
        (Path(scratch) / "problem.h").write_text(text)
        sources = [HERE / "embedded_daqp.c", HERE / "embedded_heap.c", *sorted((source / "src").glob("*.c"))]
        flags = ["-std=gnu11", f"-I{source / 'include'}", f"-I{scratch}"]
        return row_of(Board(compiled("gcc", cpu, flags, sources, Path(scratch))), mpc, command)


def condensed(mpc: Linear) -> tuple[np.ndarray, np.ndarray]:
    """H (N n, N n) and F (N n, 12) of the cost u' H u / 2 + (F x)' u in all inputs of NODES nodes, x the state now."""
    n, m = mpc.B.shape
    free, driven = np.eye(n), np.zeros((n, NODES * m))
    H, F = np.kron(np.eye(NODES), 2 * mpc.R), np.zeros((NODES * m, n))
    for k in range(NODES):
        free, driven = mpc.A @ free, mpc.A @ driven
        driven[:, k * m : (k + 1) * m] += mpc.B
        H += 2 * driven.T @ mpc.Q @ driven
        F += 2 * driven.T @ mpc.Q @ free
    return H, F


def hover_model(vehicle: Any) -> tuple[np.ndarray, np.ndarray]:
    """A (12, 12) and B (12, n) of position, small angles, velocity and body rates about hover."""
    A, B = np.zeros((12, 12)), np.zeros((12, vehicle.n_rotors))
    A[0:3, 6:9] = A[3:6, 9:12] = np.eye(3)
    A[6, 4], A[7, 3] = vehicle.gravity, -vehicle.gravity
    B[8] = 1 / vehicle.mass
    B[9:12] = np.linalg.solve(vehicle.inertia_matrix, vehicle.allocation[1:])
    return A, B


def exports(folder: Path, model: Path) -> list[tuple[Path, str]]:
    """The table's controllers, exported: folder and processor of every row."""
    rows = []
    for name, settings in CONTROLLERS.items():
        for real, cpus in (("double", ("m7",)), ("float", ("m7", "m4"))):
            out = folder / f"{name} {real}".replace(" ", "_")
            known = [f"model={model}"] if name in ("gp_mpc", "linear_drag_mpc") else []
            export_controller([*settings, *known, *PATH], out, real=real)
            rows += [(out, cpu) for cpu in cpus]
    return rows


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("folders", nargs="*", type=Path)
    parser.add_argument("--cpu", choices=[*FLAGS], default="m7")
    parser.add_argument("--model", type=Path, default=Path("models/gp"), help="of gp_mpc and linear_drag_mpc")
    parser.add_argument("--daqp", type=Path, default=Path("build/daqp-0.11.0/csrc"), help="source of DAQP")
    given = parser.parse_args()
    if shutil.which(f"{TOOLS}gcc") is None:
        sys.exit(print(f"skipped: no {TOOLS}gcc here"))
    if find_spec("unicorn") is None:
        sys.exit(print("skipped: the package unicorn is not installed"))
    print("| controller | processor | step | worst | first | flash | RAM | stack | off (N) |\n" + "|---" * 9 + "|")
    with tempfile.TemporaryDirectory() as scratch:
        rows = [(folder, given.cpu) for folder in given.folders] or exports(Path(scratch), given.model)
        for folder, cpu in rows:
            show(folder.name, cpu, measured(folder, cpu))
    if not given.folders and find_spec("tinympc") is not None and shutil.which(f"{TOOLS}g++"):
        show("TinyMPC, linear, double", "m7", tinympc("m7"))
    if not given.folders and given.daqp.is_dir():
        show("DAQP, linear, double", "m7", daqp("m7", given.daqp))


def show(name: str, cpu: str, row: Mapping[str, Any]) -> None:
    """A row of the table: instructions, and bytes."""
    numbers = " | ".join(f"{row[key]:,}" for key in ("step", "worst", "first", "flash", "ram", "stack"))
    print(f"| {name} | {cpu} | {numbers} | {row['apart']:.2g} |", flush=True)


if __name__ == "__main__":
    main()
