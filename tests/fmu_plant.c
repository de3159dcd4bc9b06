/* A mass with position y and velocity v, v' = gain u + w, as an FMU of FMI 2.0 or 3.0 for tests.

   With -DARM it is a planar arm of two rods with torques tau and push at its joints, solved by a
   step of Runge-Kutta of order 4 in each communication step.
   -DFMI=2 or -DFMI=3 chooses the version. At the time fail_at [s] a step fails with the status
   fail_with: 2 asks to end the simulation, 3 is an error, 6 an early return (FMI 3.0 only).
   It is written after the standards' texts and shares nothing with the FMUs that quell exports. */
#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#ifdef ARM
enum { TIME, TAU, TAU_2, PUSH, PUSH_2, Q, Q_2, V, V_2, GAIN, FAIL_AT, FAIL_WITH, COUNT, VARIABLES };
#else
enum { TIME, U, W, Y, V, GAIN, FAIL_AT, FAIL_WITH, COUNT, VARIABLES };
#endif
enum { OK = 0, DISCARD = 2, ERROR = 3, EARLY = 6 };

typedef struct {
    double value[VARIABLES];
    void (*log)(void);
    void *environment;
    bool ended;
} Mass;

static void start(Mass *mass) {
    for (int i = 0; i < VARIABLES; i++) mass->value[i] = 0.0;
    mass->value[GAIN] = 1.0;
    mass->value[FAIL_AT] = 1e300;
    mass->value[FAIL_WITH] = ERROR;
    mass->ended = false;
}

static Mass *make(void *log, void *environment) {
    Mass *mass = malloc(sizeof *mass);
    memcpy(&mass->log, &log, sizeof log);
    mass->environment = environment;
    start(mass);
    return mass;
}

#ifdef ARM
/* Rods of 0.4 m, 2 kg and 0.3 m, 1 kg. M(q) in the angles of the joints, textbook form. */
static void rate(const double *x, const double z[4], double d[4]) {
    const double g = 9.81, l = 0.4, alpha = 2.0 * l * l / 3.0 + 0.3 * 0.3 / 3.0 + l * l;
    const double beta = l * 0.15, delta = 0.3 * 0.3 / 3.0;
    double c = cos(z[1]), s = sin(z[1]);
    double m11 = alpha + 2.0 * beta * c, m12 = delta + beta * c, m22 = delta;
    double g2 = 0.15 * g * cos(z[0] + z[1]), g1 = (2.0 * 0.2 + l) * g * cos(z[0]) + g2;
    double b1 = x[GAIN] * x[TAU] + x[PUSH] + beta * s * (2.0 * z[2] + z[3]) * z[3] - g1;
    double b2 = x[GAIN] * x[TAU_2] + x[PUSH_2] - beta * s * z[2] * z[2] - g2;
    double det = m11 * m22 - m12 * m12;
    d[0] = z[2];
    d[1] = z[3];
    d[2] = (m22 * b1 - m12 * b2) / det;
    d[3] = (m11 * b2 - m12 * b1) / det;
}

static void move(double *x, double h) {
    double k[4][4], at[4];
    for (int part = 0; part < 4; part++) {
        double share = part == 0 ? 0.0 : part == 3 ? h : 0.5 * h;
        for (int i = 0; i < 4; i++) at[i] = x[Q + i] + (part ? share * k[part - 1][i] : 0.0);
        rate(x, at, k[part]);
    }
    for (int i = 0; i < 4; i++)
        x[Q + i] += h / 6.0 * (k[0][i] + 2.0 * k[1][i] + 2.0 * k[2][i] + k[3][i]);
}
#else
static void move(double *x, double h) {
    double force = x[GAIN] * x[U] + x[W];
    x[Y] += h * x[V] + 0.5 * h * h * force;
    x[V] += h * force;
}
#endif

static int step(Mass *mass, double t, double h) {
    double *x = mass->value;
    if (fabs(t - x[TIME]) > 1e-9) return ERROR;
    if (t + h > x[FAIL_AT]) return (int)x[FAIL_WITH];
    move(x, h);
    x[TIME] += h;
    x[COUNT] += 1.0;
    return OK;
}

static int get(Mass *mass, const uint32_t *which, size_t n, double *to) {
    for (size_t i = 0; i < n; i++) to[i] = mass->value[which[i]];
    return OK;
}

static int set(Mass *mass, const uint32_t *which, size_t n, const double *from) {
    for (size_t i = 0; i < n; i++) mass->value[which[i]] = from[i];
    return OK;
}

#define STUB(name) int name(void) { return ERROR; }

#if FMI == 2
typedef struct { void *logger, *allocate, *release, *finished, *environment; } Callbacks;
typedef void Log(void *, const char *, int, const char *, const char *, ...);

static int save(Mass *mass, void **state) {
    if (!*state) *state = malloc(sizeof mass->value);
    memcpy(*state, mass->value, sizeof mass->value);
    return OK;
}

const char *fmi2GetVersion(void) { return "2.0"; }
const char *fmi2GetTypesPlatform(void) { return "default"; }
void *fmi2Instantiate(const char *name, int type, const char *guid, const char *resources,
                      const Callbacks *callbacks, int visible, int logging) {
    return strcmp(guid, "{mass}") ? NULL : make(callbacks->logger, callbacks->environment);
}
void fmi2FreeInstance(void *mass) { free(mass); }
int fmi2SetupExperiment(void *mass, int a, double b, double c, int d, double e) { return OK; }
int fmi2EnterInitializationMode(void *mass) { return OK; }
int fmi2ExitInitializationMode(void *mass) { return OK; }
int fmi2Reset(void *mass) { start(mass); return OK; }
int fmi2GetReal(void *m, const uint32_t *v, size_t n, double *to) { return get(m, v, n, to); }
int fmi2SetReal(void *m, const uint32_t *v, size_t n, const double *x) { return set(m, v, n, x); }
int fmi2SetInteger(void *mass, const uint32_t *which, size_t n, const int *from) {
    for (size_t i = 0; i < n; i++) ((Mass *)mass)->value[which[i]] = from[i];
    return OK;
}
int fmi2GetInteger(void *mass, const uint32_t *which, size_t n, int *to) {
    for (size_t i = 0; i < n; i++) to[i] = (int)((Mass *)mass)->value[which[i]];
    return OK;
}
int fmi2GetFMUstate(void *mass, void **state) { return save(mass, state); }
int fmi2SetFMUstate(void *mass, void *state) {
    memcpy(((Mass *)mass)->value, state, sizeof((Mass *)mass)->value);
    return OK;
}
int fmi2FreeFMUstate(void *mass, void **state) { free(*state); *state = NULL; return OK; }
int fmi2GetBooleanStatus(void *mass, int kind, int *value) {
    *value = kind == 3 && ((Mass *)mass)->ended;
    return OK;
}
int fmi2DoStep(void *instance, double t, double h, int keep) {
    Mass *mass = instance;
    int status = step(mass, t, h);
    mass->ended = status == DISCARD;
    if (status == ERROR) {
        Log *log;
        memcpy(&log, &mass->log, sizeof log);
        log(mass->environment, "mass", ERROR, "logStatusError", "the mass is stuck");
    }
    return status;
}
STUB(fmi2SetDebugLogging) STUB(fmi2Terminate) STUB(fmi2GetBoolean)
STUB(fmi2GetString) STUB(fmi2SetBoolean) STUB(fmi2SetString) STUB(fmi2SerializedFMUstateSize)
STUB(fmi2SerializeFMUstate) STUB(fmi2DeSerializeFMUstate) STUB(fmi2GetDirectionalDerivative)
STUB(fmi2SetRealInputDerivatives) STUB(fmi2GetRealOutputDerivatives) STUB(fmi2CancelStep)
STUB(fmi2GetStatus) STUB(fmi2GetRealStatus) STUB(fmi2GetIntegerStatus) STUB(fmi2GetStringStatus)
#else
typedef void Log(void *, int, const char *, const char *);

const char *fmi3GetVersion(void) { return "3.0"; }
void *fmi3InstantiateCoSimulation(const char *name, const char *token, const char *resources,
                                  bool visible, bool logging, bool events, bool early,
                                  const uint32_t *intermediate, size_t n, void *environment,
                                  void *log, void *update) {
    return strcmp(token, "{mass}") ? NULL : make(log, environment);
}
void fmi3FreeInstance(void *mass) { free(mass); }
int fmi3EnterInitializationMode(void *mass, bool a, double b, double c, bool d, double e) {
    return OK;
}
int fmi3ExitInitializationMode(void *mass) { return OK; }
int fmi3Reset(void *mass) { start(mass); return OK; }
int fmi3GetFloat64(void *m, const uint32_t *v, size_t n, double *to, size_t k) {
    return get(m, v, n, to);
}
int fmi3SetFloat64(void *m, const uint32_t *v, size_t n, const double *from, size_t k) {
    return set(m, v, n, from);
}
int fmi3SetInt32(void *mass, const uint32_t *which, size_t n, const int32_t *from, size_t k) {
    for (size_t i = 0; i < n; i++) ((Mass *)mass)->value[which[i]] = from[i];
    return OK;
}
int fmi3GetInt32(void *mass, const uint32_t *which, size_t n, int32_t *to, size_t k) {
    for (size_t i = 0; i < n; i++) to[i] = (int32_t)((Mass *)mass)->value[which[i]];
    return OK;
}
int fmi3DoStep(void *instance, double t, double h, bool keep, bool *event, bool *terminate,
               bool *early, double *reached) {
    Mass *mass = instance;
    int status = step(mass, t, h);
    *event = false;
    *terminate = status == DISCARD;
    *early = status == EARLY;
    *reached = mass->value[TIME];
    if (status == ERROR) {
        Log *log;
        memcpy(&log, &mass->log, sizeof log);
        log(mass->environment, ERROR, "error", "the mass is stuck");
    }
    return status == ERROR ? ERROR : OK;
}
STUB(fmi3ActivateModelPartition) STUB(fmi3CompletedIntegratorStep) STUB(fmi3DeserializeFMUState)
STUB(fmi3EnterConfigurationMode) STUB(fmi3EnterContinuousTimeMode) STUB(fmi3EnterEventMode)
STUB(fmi3EnterStepMode) STUB(fmi3EvaluateDiscreteStates) STUB(fmi3ExitConfigurationMode)
STUB(fmi3FreeFMUState) STUB(fmi3GetAdjointDerivative) STUB(fmi3GetBinary) STUB(fmi3GetBoolean)
STUB(fmi3GetClock) STUB(fmi3GetContinuousStateDerivatives) STUB(fmi3GetContinuousStates)
STUB(fmi3GetDirectionalDerivative) STUB(fmi3GetEventIndicators) STUB(fmi3GetFMUState)
STUB(fmi3GetFloat32) STUB(fmi3GetInt16) STUB(fmi3GetInt64) STUB(fmi3GetInt8)
STUB(fmi3GetIntervalDecimal) STUB(fmi3GetIntervalFraction) STUB(fmi3GetNominalsOfContinuousStates)
STUB(fmi3GetNumberOfContinuousStates) STUB(fmi3GetNumberOfEventIndicators)
STUB(fmi3GetNumberOfVariableDependencies) STUB(fmi3GetOutputDerivatives) STUB(fmi3GetShiftDecimal)
STUB(fmi3GetShiftFraction) STUB(fmi3GetString) STUB(fmi3GetUInt16) STUB(fmi3GetUInt32)
STUB(fmi3GetUInt64) STUB(fmi3GetUInt8) STUB(fmi3GetVariableDependencies)
STUB(fmi3InstantiateModelExchange) STUB(fmi3InstantiateScheduledExecution)
STUB(fmi3SerializeFMUState) STUB(fmi3SerializedFMUStateSize) STUB(fmi3SetBinary)
STUB(fmi3SetBoolean) STUB(fmi3SetClock) STUB(fmi3SetContinuousStates) STUB(fmi3SetDebugLogging)
STUB(fmi3SetFMUState) STUB(fmi3SetFloat32) STUB(fmi3SetInt16) STUB(fmi3SetInt64) STUB(fmi3SetInt8)
STUB(fmi3SetIntervalDecimal) STUB(fmi3SetIntervalFraction) STUB(fmi3SetShiftDecimal)
STUB(fmi3SetShiftFraction) STUB(fmi3SetString) STUB(fmi3SetTime) STUB(fmi3SetUInt16)
STUB(fmi3SetUInt32) STUB(fmi3SetUInt64) STUB(fmi3SetUInt8) STUB(fmi3Terminate)
STUB(fmi3UpdateDiscreteStates)
#endif
