/* A co-simulation FMU of FMI 3.0 around the model of model.h, which is sampled at a fixed time.

   The model has its own clock: its samples are at the start time plus k times MODEL_SAMPLE_TIME.
   fmi3DoStep takes all samples from its beginning to before its end with the inputs as they are
   set, so a communication step may have any length; outputs are those after the last sample.
   Sections are those of the FMI 3.0.1 specification. */

#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "fmi3Functions.h"
#include "model.h"
#include "refuse.h"

/* Part of a sample by which times may differ: far above rounding, far below any step. */
#define TOLERANCE 1e-6
/* Value reference of the first variable that is true or false. */
#define FIRST_FLAG (MODEL_REALS + MODEL_INTEGERS)
/* Longest message [characters]. */
#define MESSAGE 200

/* States of an instance (2.3, 4.2); each is a bit, so that functions can name several. */
typedef enum {
    INSTANTIATED = 1,
    INITIALISING = 2,
    STEPPING = 4,
    TERMINATED = 8,
    FAILED = 16
} Mode;

/* All that changes after the instantiation: the FMU state of fmi3GetFMUState. */
typedef struct {
    char token[sizeof MODEL_TOKEN];
    model m;
    double start;      /* time of the first sample [s] */
    uint64_t samples;  /* samples taken */
    Mode mode;
    bool changed;      /* a parameter was set and does not act yet */
} Memory;

typedef struct {
    Memory now;
    fmi3LogMessageCallback log;
    fmi3InstanceEnvironment environment;
} Instance;

static fmi3Status fail(const Instance *instance, const char *function, const char *what) {
    char message[MESSAGE];
    if (instance != NULL && instance->log != NULL) {
        (void)snprintf(message, sizeof message, "%s: %s", function, what);
        instance->log(instance->environment, fmi3Error, "error", message);
    }
    return fmi3Error;
}

/* Whether a function may be called now; a message says so if not. */
static bool allowed(const Instance *instance, const char *function, int modes) {
    if (instance == NULL) return false;
    if (((int)instance->now.mode & modes) != 0) return true;
    (void)fail(instance, function, "is not allowed in this state of the instance");
    return false;
}

static void start_again(Memory *memory) {
    memset(memory, 0, sizeof *memory);
    memcpy(memory->token, MODEL_TOKEN, sizeof MODEL_TOKEN);
    model_reset(&memory->m);
    memory->mode = INSTANTIATED;
}

/* Let parameters that were set act; they are checked here because they are set one by one. */
static fmi3Status tune(Instance *instance, const char *function) {
    const char *problem;
    if (!instance->now.changed) return fmi3OK;
    problem = model_tune(&instance->now.m);
    if (problem != NULL) return fail(instance, function, problem);
    instance->now.changed = false;
    return fmi3OK;
}

/* ---- Version, logging, instances (2.3.1, 2.3.2) ---- */

const char *fmi3GetVersion(void) { return fmi3Version; }

fmi3Status fmi3SetDebugLogging(fmi3Instance instance, fmi3Boolean loggingOn, size_t nCategories,
                               const fmi3String categories[]) {
    (void)loggingOn; /* errors are the only messages */
    (void)nCategories;
    (void)categories;
    return instance != NULL ? fmi3OK : fmi3Error;
}

fmi3Instance fmi3InstantiateCoSimulation(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3Boolean eventModeUsed,
    fmi3Boolean earlyReturnAllowed, const fmi3ValueReference requiredIntermediateVariables[],
    size_t nRequiredIntermediateVariables, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3IntermediateUpdateCallback intermediateUpdate) {
    Instance *instance = calloc(1, sizeof *instance);
    (void)instanceName;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)eventModeUsed;
    (void)earlyReturnAllowed;
    (void)requiredIntermediateVariables;
    (void)intermediateUpdate;
    if (instance == NULL) return NULL;
    instance->log = logMessage;
    instance->environment = instanceEnvironment;
    if (instantiationToken == NULL || strcmp(instantiationToken, MODEL_TOKEN) != 0) {
        (void)fail(instance, "fmi3InstantiateCoSimulation",
                   "the instantiationToken is not that of this FMU");
        free(instance);
        return NULL;
    }
    if (nRequiredIntermediateVariables > 0) {
        (void)fail(instance, "fmi3InstantiateCoSimulation", "there are no intermediate variables");
        free(instance);
        return NULL;
    }
    start_again(&instance->now);
    return instance;
}

static fmi3Instance no_instance(fmi3LogMessageCallback log, fmi3InstanceEnvironment environment,
                                const char *function) {
    if (log != NULL) {
        char message[MESSAGE];
        (void)snprintf(message, sizeof message, "%s: is for co-simulation only", function);
        log(environment, fmi3Error, "error", message);
    }
    return NULL;
}

fmi3Instance fmi3InstantiateModelExchange(fmi3String instanceName, fmi3String instantiationToken,
                                          fmi3String resourcePath, fmi3Boolean visible,
                                          fmi3Boolean loggingOn,
                                          fmi3InstanceEnvironment instanceEnvironment,
                                          fmi3LogMessageCallback logMessage) {
    (void)instanceName;
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    return no_instance(logMessage, instanceEnvironment, "fmi3InstantiateModelExchange");
}

fmi3Instance fmi3InstantiateScheduledExecution(
    fmi3String instanceName, fmi3String instantiationToken, fmi3String resourcePath,
    fmi3Boolean visible, fmi3Boolean loggingOn, fmi3InstanceEnvironment instanceEnvironment,
    fmi3LogMessageCallback logMessage, fmi3ClockUpdateCallback clockUpdate,
    fmi3LockPreemptionCallback lockPreemption, fmi3UnlockPreemptionCallback unlockPreemption) {
    (void)instanceName;
    (void)instantiationToken;
    (void)resourcePath;
    (void)visible;
    (void)loggingOn;
    (void)clockUpdate;
    (void)lockPreemption;
    (void)unlockPreemption;
    return no_instance(logMessage, instanceEnvironment, "fmi3InstantiateScheduledExecution");
}

void fmi3FreeInstance(fmi3Instance instance) { free(instance); }

/* ---- Initialisation, end, reset (2.3.3 to 2.3.6) ---- */

fmi3Status fmi3EnterInitializationMode(fmi3Instance instance, fmi3Boolean toleranceDefined,
                                       fmi3Float64 tolerance, fmi3Float64 startTime,
                                       fmi3Boolean stopTimeDefined, fmi3Float64 stopTime) {
    Instance *self = instance;
    (void)toleranceDefined;
    (void)tolerance;
    (void)stopTimeDefined;
    (void)stopTime;
    if (!allowed(self, "fmi3EnterInitializationMode", INSTANTIATED)) return fmi3Error;
    if (!isfinite(startTime)) {
        return fail(self, "fmi3EnterInitializationMode", "startTime must be finite");
    }
    self->now.start = startTime;
    self->now.m.real[0] = startTime;
    self->now.mode = INITIALISING;
    return fmi3OK;
}

fmi3Status fmi3ExitInitializationMode(fmi3Instance instance) {
    Instance *self = instance;
    if (!allowed(self, "fmi3ExitInitializationMode", INITIALISING)) return fmi3Error;
    if (tune(self, "fmi3ExitInitializationMode") != fmi3OK) return fmi3Error;
    model_begin(&self->now.m);
    self->now.mode = STEPPING;
    return fmi3OK;
}

fmi3Status fmi3Terminate(fmi3Instance instance) {
    Instance *self = instance;
    if (!allowed(self, "fmi3Terminate", STEPPING)) return fmi3Error;
    self->now.mode = TERMINATED;
    return fmi3OK;
}

fmi3Status fmi3Reset(fmi3Instance instance) {
    Instance *self = instance;
    if (self == NULL) return fmi3Error;
    start_again(&self->now);
    return fmi3OK;
}

/* ---- Values (2.2.6) ---- */

fmi3Status fmi3GetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Float64 values[], size_t nValues) {
    Instance *self = instance;
    size_t i;
    if (self == NULL || nValues != nValueReferences) return fmi3Error;
    if (self->now.mode == INITIALISING) { /* outputs follow what was set */
        if (tune(self, "fmi3GetFloat64") != fmi3OK) return fmi3Error;
        model_begin(&self->now.m);
    }
    for (i = 0; i < nValueReferences; i++) {
        if (valueReferences[i] >= MODEL_REALS) {
            return fail(self, "fmi3GetFloat64", "there is no such variable of this type");
        }
        values[i] = self->now.m.real[valueReferences[i]];
    }
    return fmi3OK;
}

fmi3Status fmi3GetInt32(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Int32 values[], size_t nValues) {
    const Instance *self = instance;
    size_t i;
    if (self == NULL || nValues != nValueReferences) return fmi3Error;
    for (i = 0; i < nValueReferences; i++) {
        const fmi3ValueReference which = valueReferences[i];
        if (which < MODEL_REALS || which >= MODEL_REALS + MODEL_INTEGERS) {
            return fail(self, "fmi3GetInt32", "there is no such variable of this type");
        }
        values[i] = self->now.m.integer[which - MODEL_REALS];
    }
    return fmi3OK;
}

fmi3Status fmi3SetFloat64(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Float64 values[], size_t nValues) {
    Instance *self = instance;
    size_t i;
    if (!allowed(self, "fmi3SetFloat64", INSTANTIATED | INITIALISING | STEPPING)) return fmi3Error;
    if (nValues != nValueReferences) return fmi3Error;
    for (i = 0; i < nValueReferences; i++) {
        const fmi3ValueReference which = valueReferences[i];
        const Role role = which < MODEL_REALS ? model_roles[which] : MODEL_OUTPUT;
        const bool fixed = role == MODEL_FIXED && self->now.mode == STEPPING;
        if (role == MODEL_OUTPUT || fixed) {
            return fail(self, "fmi3SetFloat64", "this variable can't be set now");
        }
        self->now.m.real[which] = values[i];
        if (role != MODEL_INPUT) self->now.changed = true;
    }
    return fmi3OK;
}

fmi3Status fmi3GetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, fmi3Boolean values[], size_t nValues) {
    const Instance *self = instance;
    size_t i;
    if (self == NULL || nValues != nValueReferences) return fmi3Error;
    for (i = 0; i < nValueReferences; i++) {
        const fmi3ValueReference which = valueReferences[i];
        if (which < FIRST_FLAG || which >= FIRST_FLAG + MODEL_FLAGS) {
            return fail(self, "fmi3GetBoolean", "there is no such variable of this type");
        }
        values[i] = self->now.m.flag[which - FIRST_FLAG];
    }
    return fmi3OK;
}

fmi3Status fmi3SetBoolean(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                          size_t nValueReferences, const fmi3Boolean values[], size_t nValues) {
    Instance *self = instance;
    size_t i;
    if (!allowed(self, "fmi3SetBoolean", INSTANTIATED | INITIALISING | STEPPING)) return fmi3Error;
    if (nValues != nValueReferences) return fmi3Error;
    for (i = 0; i < nValueReferences; i++) {
        const fmi3ValueReference which = valueReferences[i];
        if (which < FIRST_FLAG || which >= FIRST_FLAG + MODEL_FLAGS) {
            return fail(self, "fmi3SetBoolean", "there is no such variable of this type");
        }
        self->now.m.flag[which - FIRST_FLAG] = values[i];
    }
    return fmi3OK;
}

/* The other types have no variables: only empty lists are right. */
static fmi3Status none(const Instance *instance, const char *function, size_t count) {
    if (instance != NULL && count == 0) return fmi3OK;
    return fail(instance, function, "there is no variable of this type");
}

#define NONE(name, type)                                                                          \
    fmi3Status name(fmi3Instance instance, const fmi3ValueReference valueReferences[],            \
                    size_t nValueReferences, type values[], size_t nValues) {                     \
        (void)valueReferences;                                                                    \
        (void)values;                                                                             \
        (void)nValues;                                                                            \
        return none(instance, #name, nValueReferences);                                           \
    }

NONE(fmi3GetFloat32, fmi3Float32)
NONE(fmi3GetInt8, fmi3Int8)
NONE(fmi3GetUInt8, fmi3UInt8)
NONE(fmi3GetInt16, fmi3Int16)
NONE(fmi3GetUInt16, fmi3UInt16)
NONE(fmi3GetUInt32, fmi3UInt32)
NONE(fmi3GetInt64, fmi3Int64)
NONE(fmi3GetUInt64, fmi3UInt64)
NONE(fmi3GetString, fmi3String)
NONE(fmi3SetFloat32, const fmi3Float32)
NONE(fmi3SetInt8, const fmi3Int8)
NONE(fmi3SetUInt8, const fmi3UInt8)
NONE(fmi3SetInt16, const fmi3Int16)
NONE(fmi3SetUInt16, const fmi3UInt16)
NONE(fmi3SetInt32, const fmi3Int32)
NONE(fmi3SetUInt32, const fmi3UInt32)
NONE(fmi3SetInt64, const fmi3Int64)
NONE(fmi3SetUInt64, const fmi3UInt64)
NONE(fmi3SetString, const fmi3String)

fmi3Status fmi3GetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, size_t valueSizes[], fmi3Binary values[],
                         size_t nValues) {
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    (void)nValues;
    return none(instance, "fmi3GetBinary", nValueReferences);
}

fmi3Status fmi3SetBinary(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                         size_t nValueReferences, const size_t valueSizes[],
                         const fmi3Binary values[], size_t nValues) {
    (void)valueReferences;
    (void)valueSizes;
    (void)values;
    (void)nValues;
    return none(instance, "fmi3SetBinary", nValueReferences);
}

fmi3Status fmi3GetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, fmi3Clock values[]) {
    (void)valueReferences;
    (void)values;
    return none(instance, "fmi3GetClock", nValueReferences);
}

fmi3Status fmi3SetClock(fmi3Instance instance, const fmi3ValueReference valueReferences[],
                        size_t nValueReferences, const fmi3Clock values[]) {
    (void)valueReferences;
    (void)values;
    return none(instance, "fmi3SetClock", nValueReferences);
}

/* ---- State (2.2.10) ---- */

fmi3Status fmi3GetFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    const Instance *self = instance;
    if (self == NULL || FMUState == NULL) return fmi3Error;
    if (*FMUState == NULL) *FMUState = malloc(sizeof self->now);
    if (*FMUState == NULL) return fail(self, "fmi3GetFMUState", "there is not enough memory");
    memcpy(*FMUState, &self->now, sizeof self->now);
    return fmi3OK;
}

fmi3Status fmi3SetFMUState(fmi3Instance instance, fmi3FMUState FMUState) {
    Instance *self = instance;
    if (self == NULL || FMUState == NULL) return fmi3Error;
    memcpy(&self->now, FMUState, sizeof self->now);
    model_moved(&self->now.m);
    return fmi3OK;
}

fmi3Status fmi3FreeFMUState(fmi3Instance instance, fmi3FMUState *FMUState) {
    (void)instance;
    if (FMUState != NULL) {
        free(*FMUState);
        *FMUState = NULL;
    }
    return fmi3OK;
}

fmi3Status fmi3SerializedFMUStateSize(fmi3Instance instance, fmi3FMUState FMUState, size_t *size) {
    if (instance == NULL || FMUState == NULL || size == NULL) return fmi3Error;
    *size = sizeof(Memory);
    return fmi3OK;
}

fmi3Status fmi3SerializeFMUState(fmi3Instance instance, fmi3FMUState FMUState,
                                 fmi3Byte serializedState[], size_t size) {
    if (instance == NULL || FMUState == NULL) return fmi3Error;
    if (size < sizeof(Memory)) {
        return fail(instance, "fmi3SerializeFMUState", "the array is too short");
    }
    memcpy(serializedState, FMUState, sizeof(Memory));
    return fmi3OK;
}

fmi3Status fmi3DeserializeFMUState(fmi3Instance instance, const fmi3Byte serializedState[],
                                   size_t size, fmi3FMUState *FMUState) {
    if (instance == NULL || FMUState == NULL) return fmi3Error;
    if (size != sizeof(Memory) || memcmp(serializedState, MODEL_TOKEN, sizeof MODEL_TOKEN) != 0) {
        return fail(instance, "fmi3DeserializeFMUState", "is not a state of this FMU");
    }
    if (*FMUState == NULL) *FMUState = malloc(sizeof(Memory));
    if (*FMUState == NULL) {
        return fail(instance, "fmi3DeserializeFMUState", "there is not enough memory");
    }
    memcpy(*FMUState, serializedState, sizeof(Memory));
    return fmi3OK;
}

/* ---- Co-simulation (4.2) ---- */

fmi3Status fmi3DoStep(fmi3Instance instance, fmi3Float64 currentCommunicationPoint,
                      fmi3Float64 communicationStepSize,
                      fmi3Boolean noSetFMUStatePriorToCurrentPoint,
                      fmi3Boolean *eventHandlingNeeded, fmi3Boolean *terminateSimulation,
                      fmi3Boolean *earlyReturn, fmi3Float64 *lastSuccessfulTime) {
    Instance *self = instance;
    Memory *now;
    double end, next;
    (void)noSetFMUStatePriorToCurrentPoint;
    if (!allowed(self, "fmi3DoStep", STEPPING)) return fmi3Error;
    now = &self->now;
    if (eventHandlingNeeded != NULL) *eventHandlingNeeded = fmi3False;
    if (terminateSimulation != NULL) *terminateSimulation = fmi3False;
    if (earlyReturn != NULL) *earlyReturn = fmi3False;
    if (lastSuccessfulTime != NULL) *lastSuccessfulTime = now->m.real[0];
    if (!(fabs(currentCommunicationPoint - now->m.real[0]) <= TOLERANCE * MODEL_SAMPLE_TIME)) {
        return fail(self, "fmi3DoStep", "currentCommunicationPoint is not where the last step ended");
    }
    end = currentCommunicationPoint + communicationStepSize;
    if (!(communicationStepSize > 0.0 && isfinite(end))) {
        return fail(self, "fmi3DoStep", "communicationStepSize must be positive");
    }
    if (tune(self, "fmi3DoStep") != fmi3OK) return fmi3Error;
    for (;;) {
        next = now->start + (double)now->samples * MODEL_SAMPLE_TIME;
        if (!(next < end - TOLERANCE * MODEL_SAMPLE_TIME)) break;
        model_sample(&now->m, next);
        now->samples++;
    }
    now->m.real[0] = end;
    if (lastSuccessfulTime != NULL) *lastSuccessfulTime = end;
    return fmi3OK;
}

fmi3Status refuse(fmi3Instance instance, const char *function) {
    return fail(instance, function, "this FMU does not have this ability");
}
