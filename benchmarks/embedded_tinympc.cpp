// The code that TinyMPC generates in an emulator: embedded.py writes where it is and reads what it answers. Its matrices
// are allocated as the program begins.
#include "tinympc/admm.hpp"
#include "tinympc/tiny_data.hpp"

extern "C" {
double t_state[12], t_command[4];
int t_heap; // bytes that were allocated
void *__dso_handle;
extern void (*__init_array_start[])(void), (*__init_array_end[])(void);

void t_reset(void) {
    for (void (**begin)(void) = __init_array_start; begin < __init_array_end; begin++) (*begin)();
}

void t_step(void) {
    for (int i = 0; i < 12; i++) tiny_solver.work->x(i, 0) = t_state[i];
    solve(&tiny_solver);
    for (int i = 0; i < 4; i++) t_command[i] = tiny_solver.work->znew(i, 0);
}

static char heap[200000] __attribute__((section(".noinit")));
void *_sbrk(int size) {
    void *place = heap + t_heap;
    t_heap += size;
    return place;
}
void _exit(int) { for (;;); }
int _write(int, char *, int count) { return count; }
int _read(int, char *, int) { return 0; }
int _close(int) { return -1; }
int _lseek(int, int, int) { return 0; }
int _fstat(int, void *) { return 0; }
int _isatty(int) { return 1; }
int _kill(int, int) { return 0; }
int _getpid(void) { return 1; }
}
