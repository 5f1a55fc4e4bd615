/* Hides AVX-512 from a program, so that compilers and libraries see a Haswell processor with AVX2.
 *
 * When preloaded, this library makes every CPUID instruction fault (arch_prctl(ARCH_CPUID), which needs Linux and a
 * processor with CPUID faulting), answers the faults itself, and prevents the handler of SIGSEGV from being replaced.
 */
#define _GNU_SOURCE
#include <cpuid.h>
#include <dlfcn.h>
#include <signal.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/syscall.h>
#include <ucontext.h>
#include <unistd.h>

#define ARCH_CPUID_CONTROL 0x1012

/* Bits of leaf 7 that belong to AVX-512, AVX-VNNI and AMX. */
#define LEAF_7_EBX (1u << 16 | 1u << 17 | 1u << 21 | 1u << 26 | 1u << 27 | 1u << 28 | 1u << 30 | 1u << 31)
#define LEAF_7_ECX (1u << 1 | 1u << 6 | 1u << 11 | 1u << 12 | 1u << 14)
#define LEAF_7_EDX (1u << 2 | 1u << 3 | 1u << 8 | 1u << 22 | 1u << 23 | 1u << 24 | 1u << 25)
#define LEAF_7_1_EAX (1u << 4 | 1u << 5)
#define HASWELL 0x000306c3

static struct sigaction theirs;
static int (*real_sigaction)(int, const struct sigaction *, struct sigaction *);

static long faulting(int on)
{
    return syscall(SYS_arch_prctl, ARCH_CPUID_CONTROL, !on);
}

static void answer(int number, siginfo_t *info, void *context)
{
    greg_t *registers = ((ucontext_t *)context)->uc_mcontext.gregs;
    if (info->si_code != SI_KERNEL || memcmp((const void *)registers[REG_RIP], "\x0f\xa2", 2)) {
        /* A fault of the program itself: its own handler takes over when the instruction is repeated. */
        real_sigaction(SIGSEGV, &theirs, NULL);
        return;
    }
    const uint32_t leaf = registers[REG_RAX], part = registers[REG_RCX];
    uint32_t a, b, c, d;
    faulting(0);
    __cpuid_count(leaf, part, a, b, c, d);
    faulting(1);
    if (leaf == 1)
        a = HASWELL;
    if (leaf == 7 && part == 0) {
        b &= ~LEAF_7_EBX;
        c &= ~LEAF_7_ECX;
        d &= ~LEAF_7_EDX;
    }
    if (leaf == 7 && part == 1)
        a &= ~LEAF_7_1_EAX;
    registers[REG_RAX] = a;
    registers[REG_RBX] = b;
    registers[REG_RCX] = c;
    registers[REG_RDX] = d;
    registers[REG_RIP] += 2;
}

int sigaction(int number, const struct sigaction *new, struct sigaction *old)
{
    if (!real_sigaction)
        real_sigaction = dlsym(RTLD_NEXT, "sigaction");
    if (number != SIGSEGV)
        return real_sigaction(number, new, old);
    if (old)
        *old = theirs;
    if (new)
        theirs = *new;
    return 0;
}

sighandler_t signal(int number, sighandler_t handler)
{
    struct sigaction new = {.sa_handler = handler, .sa_flags = SA_RESTART}, old;
    return sigaction(number, &new, &old) ? SIG_ERR : old.sa_handler;
}

__attribute__((constructor)) static void start(void)
{
    struct sigaction ours = {.sa_sigaction = answer, .sa_flags = SA_SIGINFO | SA_NODEFER};
    real_sigaction = dlsym(RTLD_NEXT, "sigaction");
    real_sigaction(SIGSEGV, &ours, &theirs);
    if (faulting(1)) {
        perror("CPUID faulting");
        exit(1);
    }
}
