/* FMI 2.0 for co-simulation around the FMU of FMI 3.0 in fmi3.c, which does the work: here are the
   names, types and calls of the older version. Sections are those of the FMI 2.0.4 specification. */

#define FMI3_Export /* no tool looks for these functions in an FMU of FMI 2.0 */
#include "fmi3.c"

#include "fmi2Functions.h"

#ifdef __GNUC__ /* also clang: functions that refuse use no other arguments */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

typedef struct {
    fmi3Instance inner;
    fmi2CallbackLogger logger;
    fmi2ComponentEnvironment environment;
    double start_time;
    char name[MESSAGE];
} Component;

#define INNER(c) ((c) != NULL ? ((Component *)(c))->inner : NULL)

/* The callback of FMI 3.0, which passes messages on. A message is no format of printf. */
static void pass_on(fmi3InstanceEnvironment environment, fmi3Status status, fmi3String category,
                    fmi3String message) {
    Component *self = environment;
    if (self->logger != NULL) {
        self->logger(self->environment, self->name, (fmi2Status)status, category, "%s", message);
    }
}

static fmi2Status no_ability(fmi2Component c, const char *function) {
    return (fmi2Status)refuse(INNER(c), function);
}

/* ---- Version, logging, instances (2.1.2, 2.1.5) ---- */

const char *fmi2GetTypesPlatform(void) { return fmi2TypesPlatform; }
const char *fmi2GetVersion(void) { return fmi2Version; }

fmi2Status fmi2SetDebugLogging(fmi2Component c, fmi2Boolean loggingOn, size_t nCategories,
                               const fmi2String categories[]) {
    return (fmi2Status)fmi3SetDebugLogging(INNER(c), loggingOn != 0, nCategories, categories);
}

fmi2Component fmi2Instantiate(fmi2String instanceName, fmi2Type fmuType, fmi2String fmuGUID,
                              fmi2String fmuResourceLocation,
                              const fmi2CallbackFunctions *functions, fmi2Boolean visible,
                              fmi2Boolean loggingOn) {
    Component *self = calloc(1, sizeof *self);
    if (self == NULL) return NULL;
    if (functions != NULL) {
        self->logger = functions->logger;
        self->environment = functions->componentEnvironment;
    }
    (void)snprintf(self->name, sizeof self->name, "%s", instanceName != NULL ? instanceName : "");
    if (fmuType == fmi2CoSimulation) {
        self->inner = fmi3InstantiateCoSimulation(self->name, fmuGUID, fmuResourceLocation,
                                                  visible != 0, loggingOn != 0, false, false, NULL,
                                                  0, self, pass_on, NULL);
    } else {
        pass_on(self, fmi3Error, "error", "fmi2Instantiate: is for co-simulation only");
    }
    if (self->inner == NULL) {
        free(self);
        return NULL;
    }
    return self;
}

void fmi2FreeInstance(fmi2Component c) {
    if (c == NULL) return;
    fmi3FreeInstance(INNER(c));
    free(c);
}

/* ---- Initialisation, end, reset (2.1.6) ---- */

fmi2Status fmi2SetupExperiment(fmi2Component c, fmi2Boolean toleranceDefined, fmi2Real tolerance,
                               fmi2Real startTime, fmi2Boolean stopTimeDefined, fmi2Real stopTime) {
    Component *self = c;
    if (self == NULL || !allowed(self->inner, "fmi2SetupExperiment", INSTANTIATED)) {
        return fmi2Error;
    }
    self->start_time = startTime;
    return fmi2OK;
}

fmi2Status fmi2EnterInitializationMode(fmi2Component c) {
    const double start_time = c != NULL ? ((Component *)c)->start_time : 0.0;
    return (fmi2Status)fmi3EnterInitializationMode(INNER(c), false, 0.0, start_time, false, 0.0);
}

fmi2Status fmi2ExitInitializationMode(fmi2Component c) {
    return (fmi2Status)fmi3ExitInitializationMode(INNER(c));
}

fmi2Status fmi2Terminate(fmi2Component c) { return (fmi2Status)fmi3Terminate(INNER(c)); }

fmi2Status fmi2Reset(fmi2Component c) {
    if (c != NULL) ((Component *)c)->start_time = 0.0;
    return (fmi2Status)fmi3Reset(INNER(c));
}

/* ---- Values (2.1.7): booleans are of another type, the others are the same ---- */

fmi2Status fmi2GetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       fmi2Real value[]) {
    return (fmi2Status)fmi3GetFloat64(INNER(c), vr, nvr, value, nvr);
}

fmi2Status fmi2SetReal(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                       const fmi2Real value[]) {
    return (fmi2Status)fmi3SetFloat64(INNER(c), vr, nvr, value, nvr);
}

fmi2Status fmi2GetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          fmi2Integer value[]) {
    return (fmi2Status)fmi3GetInt32(INNER(c), vr, nvr, value, nvr);
}

fmi2Status fmi2SetInteger(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Integer value[]) {
    return (fmi2Status)fmi3SetInt32(INNER(c), vr, nvr, value, nvr);
}

fmi2Status fmi2GetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          fmi2Boolean value[]) {
    fmi3Status status = c != NULL ? fmi3OK : fmi3Error;
    size_t i;
    for (i = 0; i < nvr && status == fmi3OK; i++) {
        fmi3Boolean one = false;
        status = fmi3GetBoolean(INNER(c), &vr[i], 1, &one, 1);
        value[i] = one ? fmi2True : fmi2False;
    }
    return (fmi2Status)status;
}

fmi2Status fmi2SetBoolean(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                          const fmi2Boolean value[]) {
    fmi3Status status = c != NULL ? fmi3OK : fmi3Error;
    size_t i;
    for (i = 0; i < nvr && status == fmi3OK; i++) {
        const fmi3Boolean one = value[i] != fmi2False;
        status = fmi3SetBoolean(INNER(c), &vr[i], 1, &one, 1);
    }
    return (fmi2Status)status;
}

fmi2Status fmi2GetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         fmi2String value[]) {
    return (fmi2Status)fmi3GetString(INNER(c), vr, nvr, value, nvr);
}

fmi2Status fmi2SetString(fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
                         const fmi2String value[]) {
    return (fmi2Status)fmi3SetString(INNER(c), vr, nvr, value, nvr);
}

/* ---- State (2.1.8) ---- */

fmi2Status fmi2GetFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    return (fmi2Status)fmi3GetFMUState(INNER(c), FMUstate);
}

fmi2Status fmi2SetFMUstate(fmi2Component c, fmi2FMUstate FMUstate) {
    return (fmi2Status)fmi3SetFMUState(INNER(c), FMUstate);
}

fmi2Status fmi2FreeFMUstate(fmi2Component c, fmi2FMUstate *FMUstate) {
    return (fmi2Status)fmi3FreeFMUState(INNER(c), FMUstate);
}

fmi2Status fmi2SerializedFMUstateSize(fmi2Component c, fmi2FMUstate FMUstate, size_t *size) {
    return (fmi2Status)fmi3SerializedFMUStateSize(INNER(c), FMUstate, size);
}

fmi2Status fmi2SerializeFMUstate(fmi2Component c, fmi2FMUstate FMUstate,
                                 fmi2Byte serializedState[], size_t size) {
    return (fmi2Status)fmi3SerializeFMUState(INNER(c), FMUstate, (fmi3Byte *)serializedState, size);
}

fmi2Status fmi2DeSerializeFMUstate(fmi2Component c, const fmi2Byte serializedState[], size_t size,
                                   fmi2FMUstate *FMUstate) {
    const fmi3Byte *bytes = (const fmi3Byte *)serializedState;
    return (fmi2Status)fmi3DeserializeFMUState(INNER(c), bytes, size, FMUstate);
}

/* ---- Co-simulation (4.2) ---- */

fmi2Status fmi2DoStep(fmi2Component c, fmi2Real currentCommunicationPoint,
                      fmi2Real communicationStepSize,
                      fmi2Boolean noSetFMUStatePriorToCurrentPoint) {
    return (fmi2Status)fmi3DoStep(INNER(c), currentCommunicationPoint, communicationStepSize,
                                  noSetFMUStatePriorToCurrentPoint != 0, NULL, NULL, NULL, NULL);
}

/* fmi2DoStep never returns fmi2Pending, so that there is no status to ask for, and no step to end. */
#define REFUSE(name, parameters)                                                                  \
    fmi2Status name parameters { return no_ability(c, #name); }

REFUSE(fmi2CancelStep, (fmi2Component c))
REFUSE(fmi2GetStatus, (fmi2Component c, const fmi2StatusKind s, fmi2Status *value))
REFUSE(fmi2GetRealStatus, (fmi2Component c, const fmi2StatusKind s, fmi2Real *value))
REFUSE(fmi2GetIntegerStatus, (fmi2Component c, const fmi2StatusKind s, fmi2Integer *value))
REFUSE(fmi2GetBooleanStatus, (fmi2Component c, const fmi2StatusKind s, fmi2Boolean *value))
REFUSE(fmi2GetStringStatus, (fmi2Component c, const fmi2StatusKind s, fmi2String *value))
REFUSE(fmi2SetRealInputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
        const fmi2Integer order[], const fmi2Real value[]))
REFUSE(fmi2GetRealOutputDerivatives, (fmi2Component c, const fmi2ValueReference vr[], size_t nvr,
        const fmi2Integer order[], fmi2Real value[]))
REFUSE(fmi2GetDirectionalDerivative, (fmi2Component c, const fmi2ValueReference vUnknown_ref[],
        size_t nUnknown, const fmi2ValueReference vKnown_ref[], size_t nKnown,
        const fmi2Real dvKnown[], fmi2Real dvUnknown[]))

/* ---- Model exchange (3.2), which modelDescription.xml does not declare ---- */

REFUSE(fmi2EnterEventMode, (fmi2Component c))
REFUSE(fmi2NewDiscreteStates, (fmi2Component c, fmi2EventInfo *fmi2eventInfo))
REFUSE(fmi2EnterContinuousTimeMode, (fmi2Component c))
REFUSE(fmi2CompletedIntegratorStep, (fmi2Component c, fmi2Boolean noSetFMUStatePriorToCurrentPoint,
        fmi2Boolean *enterEventMode, fmi2Boolean *terminateSimulation))
REFUSE(fmi2SetTime, (fmi2Component c, fmi2Real time))
REFUSE(fmi2SetContinuousStates, (fmi2Component c, const fmi2Real x[], size_t nx))
REFUSE(fmi2GetDerivatives, (fmi2Component c, fmi2Real derivatives[], size_t nx))
REFUSE(fmi2GetEventIndicators, (fmi2Component c, fmi2Real eventIndicators[], size_t ni))
REFUSE(fmi2GetContinuousStates, (fmi2Component c, fmi2Real x[], size_t nx))
REFUSE(fmi2GetNominalsOfContinuousStates, (fmi2Component c, fmi2Real x_nominal[], size_t nx))
