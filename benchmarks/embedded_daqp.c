/* DAQP in an emulator: embedded.py writes the state and reads the command. min u' H u / 2 + (F x)' u, low <= u <= high,
   of all inputs u of a horizon; H, F, low, high, COUNT are in problem.h. The solver is set up once, with its memory. */
#include "api.h"
#include "utils.h"
#include "problem.h"

double t_state[12], t_command[4];
static double linear[COUNT], upper[COUNT], lower[COUNT], solution[COUNT], duals[COUNT];
static DAQPWorkspace work;
static DAQPProblem problem;
static DAQPResult result;

void t_reset(void) {
    for (int i = 0; i < COUNT; i++) upper[i] = HIGH, lower[i] = LOW;
    problem.n = problem.m = problem.ms = COUNT;
    problem.H = H, problem.f = linear, problem.bupper = upper, problem.blower = lower;
    result.x = solution, result.lam = duals;
    setup_daqp(&problem, &work, 0);
}

void t_step(void) {
    for (int i = 0; i < COUNT; i++) {
        linear[i] = 0;
        for (int j = 0; j < 12; j++) linear[i] += F[i][j] * t_state[j];
    }
    daqp_update_ldp(DAQP_UPDATE_v + DAQP_UPDATE_d, &work, &problem);
    daqp_solve(&result, &work);
    for (int i = 0; i < 4; i++) t_command[i] = solution[i];
}
