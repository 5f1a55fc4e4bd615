"""Main loops found in machine code, and processors whose instructions are hidden."""

import platform
import shutil
import subprocess
from pathlib import Path

import pytest
import roofline

SCRIPTS = Path(__file__).parents[2] / "scripts"

needs_compiler = pytest.mark.skipif(
    platform.machine() != "x86_64" or not (shutil.which("gcc") and shutil.which("objdump")),
    reason="needs gcc and objdump on x86-64",
)
CPU = Path("/proc/cpuinfo")

# Two loops within an outer one. The second has the most multiply-adds and reads the stack.
LOOPS = r"""
void kernel(long n, const float *x) {
    __asm__ volatile(
        "3: mov %0, %%rcx\n"
        "1: vfmadd231ps %%ymm1, %%ymm2, %%ymm3\n dec %%rcx\n jnz 1b\n"
        "mov %0, %%rcx\n"
        "2: vfmadd231ps (%1), %%ymm2, %%ymm3\n vfnmadd213ps -32(%%rsp), %%ymm2, %%ymm4\n"
        "vpermps %%ymm1, %%ymm2, %%ymm5\n vaddps %%ymm1, %%ymm2, %%ymm6\n dec %%rcx\n jnz 2b\n"
        "dec %%rax\n jnz 3b\n"
        :: "r"(n), "r"(x) : "rcx", "rax", "memory");
}
"""


def compiled(folder, source, *options):
    path = folder / "code.c"
    path.write_text(source)
    words = ["gcc", "-O1", *options, "-o", str(folder / "code"), str(path)]
    subprocess.run(words, check=True)
    return folder / "code"


@needs_compiler
def test_the_main_loop_is_found_and_counted(tmp_path):
    loop = roofline.main_loop(compiled(tmp_path, LOOPS, "-shared", "-fPIC"))
    assert len(loop.lines) == 6
    assert loop.multiply_adds == 2
    assert roofline.counts(loop) == {
        "instructions": 6,
        "multiply-adds": 2,
        "permutes": 1,
        "memory operands": 2,
        "on the stack": 1,
    }


@needs_compiler
@pytest.mark.skipif(not shutil.which("llvm-mca"), reason="needs llvm-mca")
def test_a_loop_is_scheduled(tmp_path):
    """Both multiply-adds depend on their last result, so an iteration takes at least 4 cycles."""
    loop = roofline.main_loop(compiled(tmp_path, LOOPS, "-shared", "-fPIC"))
    cycles, port = roofline.scheduled(loop, "haswell")
    assert 4 <= int(cycles) <= 8
    assert int(port.split()[-1]) <= int(cycles)


@needs_compiler
def test_what_has_no_machine_code_is_told(tmp_path):
    (tmp_path / "text").write_text("no program")
    with pytest.raises(roofline.RooflineError, match="objdump failed"):
        roofline.main_loop(tmp_path / "text")


@needs_compiler
@pytest.mark.skipif(
    not CPU.exists() or "cpuid_fault" not in CPU.read_text().split(),
    reason="needs a processor that can fault CPUID",
)
def test_avx_512_is_hidden(tmp_path):
    source = """
        #include <stdio.h>
        int main() {
            __builtin_cpu_init();
            printf("%d %d", !!__builtin_cpu_supports("avx2"), !!__builtin_cpu_supports("avx512f"));
        }
    """
    program = compiled(tmp_path, source)
    environment = {"XDG_CACHE_HOME": str(tmp_path), "PATH": "/usr/bin:/bin"}
    words = [str(SCRIPTS / "as_avx2"), str(program)]
    done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    assert done.stdout == "1 0"
