// The code that TinyMPC generates in an emulator: embedded.py writes where it is and reads what it answers. Its matrices
// are allocated as the program begins.
#include "tinympc/admm.hpp"
#include "tinympc/tiny_data.hpp"

extern "C" {
double t_state[12], t_command[4];
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
}
