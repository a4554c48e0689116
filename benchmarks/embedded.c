/* An exported controller in an emulator: embedded.py writes what it is given and reads what it answers. */
#include "controller.h"

qx_real t_state[13], t_force[3], t_speed[QX_ROTORS], t_command[QX_ROTORS];
qx_window t_window;
int t_read, t_turning, t_status;

void t_reset(void) { t_status = qx_reset(t_state, &t_window); }
void t_step(void) { t_status = qx_step(t_state, t_read ? t_force : 0, t_turning ? t_speed : 0, &t_window, t_command); }

void _exit(int code) { (void)code; for (;;); }
int *__errno(void) { static int number; return &number; }
