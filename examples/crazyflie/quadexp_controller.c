/* An exported controller in a Crazyflie, as an out-of-tree controller of crazyflie-firmware: see docs/vehicle.md.

   The stabilizer loop (1 kHz) leaves the state and the setpoint, and takes the thrusts of the newest step. A task of
   low priority makes a step every QX_PERIOD. The firmware's PID flies until there is an answer, and where there is none
   for PATIENCE steps. It has been compiled and linked; it has not flown. */
#include <math.h>
#include <string.h>

#include "FreeRTOS.h"
#include "app.h"
#include "controller_pid.h"
#include "log.h"
#include "stabilizer_types.h"
#include "task.h"
#include "usec_time.h"

#include "controller/controller.h"

#define RADIAN 0.01745329252f /* rad of a degree */
#define GRAVITY 9.81f         /* m/s^2 of a g */
#define THRUST_MAX 0.15f      /* N of a rotor at full thrust, as vehicle=crazyflie has it */
#define PATIENCE 5            /* steps without an answer */
#define STACK_WORDS 1600      /* of the task; a step takes 5.2 kB */

/* Rotors of vehicle=crazyflie are in the order of the firmware's motors: front right, rear right, rear left, front left;
   both take world east north up, body forward left up. */
typedef struct {
  qx_real state[13], force[3], position[3], heading;
} input;

static input newest;
static qx_real thrusts[QX_ROTORS];
static int failures = PATIENCE;
static uint32_t step_us, worst_us;
static StackType_t stack[STACK_WORDS];
static StaticTask_t task;

static void steps(void *unused) {
  static input now;
  static qx_window window;
  qx_real command[QX_ROTORS];
  int begun = 0;
  (void)unused;
  TickType_t wake = xTaskGetTickCount();
  while (1) {
    vTaskDelayUntil(&wake, M2T(1000 * QX_PERIOD));
    taskENTER_CRITICAL();
    now = newest;
    taskEXIT_CRITICAL();
    const uint64_t start = usecTimestamp();
    qx_hold(&window, now.position, now.heading);
    if (!begun) begun = qx_reset(now.state, &window) == QX_OK;
    const int status = begun ? qx_step(now.state, now.force, 0, &window, command) : QX_REFUSED;
    step_us = (uint32_t)(usecTimestamp() - start);
    if (step_us > worst_us) worst_us = step_us;
    taskENTER_CRITICAL();
    if (status == QX_OK) {
      memcpy(thrusts, command, sizeof thrusts);
      failures = 0;
    } else if (failures < PATIENCE && ++failures == PATIENCE) {
      begun = 0;
    }
    taskEXIT_CRITICAL();
  }
}

void appMain(void) {
  xTaskCreateStatic(steps, "QUADEXP", STACK_WORDS, 0, 1, stack, &task);
  while (1) vTaskDelay(M2T(2000));
}

void controllerOutOfTreeInit(void) { controllerPidInit(); }

bool controllerOutOfTreeTest(void) { return controllerPidTest(); }

void controllerOutOfTree(control_t *control, const setpoint_t *setpoint, const sensorData_t *sensors,
                         const state_t *state, const stabilizerStep_t stabilizerStep) {
  const quaternion_t *q = &state->attitudeQuaternion;
  const input now = {
      .state = {state->position.x, state->position.y, state->position.z, q->w, q->x, q->y, q->z, state->velocity.x,
                state->velocity.y, state->velocity.z, sensors->gyro.x * RADIAN, sensors->gyro.y * RADIAN,
                sensors->gyro.z * RADIAN},
      .force = {sensors->acc.x * GRAVITY, sensors->acc.y * GRAVITY, sensors->acc.z * GRAVITY},
      .position = {setpoint->position.x, setpoint->position.y, setpoint->position.z},
      .heading = setpoint->attitude.yaw * RADIAN,
  };
  taskENTER_CRITICAL();
  newest = now;
  const int answered = failures < PATIENCE;
  qx_real u[QX_ROTORS];
  memcpy(u, thrusts, sizeof u);
  taskEXIT_CRITICAL();
  const int flies = setpoint->mode.x == modeAbs && setpoint->mode.y == modeAbs && setpoint->mode.z == modeAbs;
  if (!answered || !flies) {
    controllerPid(control, setpoint, sensors, state, stabilizerStep);
    return;
  }
  control->controlMode = controlModeForce;
  for (int i = 0; i < QX_ROTORS; i++) control->normalizedForces[i] = u[i] / THRUST_MAX;
}

LOG_GROUP_START(quadexp)
LOG_ADD(LOG_UINT32, stepUs, &step_us)
LOG_ADD(LOG_UINT32, worstUs, &worst_us)
LOG_GROUP_STOP(quadexp)
