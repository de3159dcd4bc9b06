/* Functions of FMI 3.0 for abilities that modelDescription.xml does not declare: model exchange,
   scheduled execution, events, clocks, configuration, derivatives. Each returns fmi3Error. */

#include "refuse.h"

#include "fmi3Functions.h"

#ifdef __GNUC__ /* also clang: none of these functions uses its other arguments */
#pragma GCC diagnostic ignored "-Wunused-parameter"
#endif

#define REFUSE(name, parameters)                                                                  \
    fmi3Status name parameters { return refuse(instance, #name); }

REFUSE(fmi3EnterEventMode, (fmi3Instance instance))
REFUSE(fmi3GetNumberOfVariableDependencies, (fmi3Instance instance,
        fmi3ValueReference valueReference, size_t *nDependencies))
REFUSE(fmi3GetVariableDependencies, (fmi3Instance instance, fmi3ValueReference dependent,
        size_t elementIndicesOfDependent[], fmi3ValueReference independents[],
        size_t elementIndicesOfIndependents[], fmi3DependencyKind dependencyKinds[],
        size_t nDependencies))
REFUSE(fmi3GetDirectionalDerivative, (fmi3Instance instance, const fmi3ValueReference unknowns[],
        size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns,
        const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity))
REFUSE(fmi3GetAdjointDerivative, (fmi3Instance instance, const fmi3ValueReference unknowns[],
        size_t nUnknowns, const fmi3ValueReference knowns[], size_t nKnowns,
        const fmi3Float64 seed[], size_t nSeed, fmi3Float64 sensitivity[], size_t nSensitivity))
REFUSE(fmi3EnterConfigurationMode, (fmi3Instance instance))
REFUSE(fmi3ExitConfigurationMode, (fmi3Instance instance))
REFUSE(fmi3GetIntervalDecimal, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3Float64 intervals[], fmi3IntervalQualifier qualifiers[]))
REFUSE(fmi3GetIntervalFraction, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[],
        fmi3IntervalQualifier qualifiers[]))
REFUSE(fmi3GetShiftDecimal, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3Float64 shifts[]))
REFUSE(fmi3GetShiftFraction, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, fmi3UInt64 counters[], fmi3UInt64 resolutions[]))
REFUSE(fmi3SetIntervalDecimal, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Float64 intervals[]))
REFUSE(fmi3SetIntervalFraction, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
REFUSE(fmi3SetShiftDecimal, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Float64 shifts[]))
REFUSE(fmi3SetShiftFraction, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3UInt64 counters[], const fmi3UInt64 resolutions[]))
REFUSE(fmi3EvaluateDiscreteStates, (fmi3Instance instance))
REFUSE(fmi3UpdateDiscreteStates, (fmi3Instance instance, fmi3Boolean *discreteStatesNeedUpdate,
        fmi3Boolean *terminateSimulation, fmi3Boolean *nominalsOfContinuousStatesChanged,
        fmi3Boolean *valuesOfContinuousStatesChanged, fmi3Boolean *nextEventTimeDefined,
        fmi3Float64 *nextEventTime))
REFUSE(fmi3EnterContinuousTimeMode, (fmi3Instance instance))
REFUSE(fmi3CompletedIntegratorStep, (fmi3Instance instance,
        fmi3Boolean noSetFMUStatePriorToCurrentPoint, fmi3Boolean *enterEventMode,
        fmi3Boolean *terminateSimulation))
REFUSE(fmi3SetTime, (fmi3Instance instance, fmi3Float64 time))
REFUSE(fmi3SetContinuousStates, (fmi3Instance instance, const fmi3Float64 continuousStates[],
        size_t nContinuousStates))
REFUSE(fmi3GetContinuousStateDerivatives, (fmi3Instance instance, fmi3Float64 derivatives[],
        size_t nContinuousStates))
REFUSE(fmi3GetEventIndicators, (fmi3Instance instance, fmi3Float64 eventIndicators[],
        size_t nEventIndicators))
REFUSE(fmi3GetContinuousStates, (fmi3Instance instance, fmi3Float64 continuousStates[],
        size_t nContinuousStates))
REFUSE(fmi3GetNominalsOfContinuousStates, (fmi3Instance instance, fmi3Float64 nominals[],
        size_t nContinuousStates))
REFUSE(fmi3GetNumberOfEventIndicators, (fmi3Instance instance, size_t *nEventIndicators))
REFUSE(fmi3GetNumberOfContinuousStates, (fmi3Instance instance, size_t *nContinuousStates))
REFUSE(fmi3EnterStepMode, (fmi3Instance instance))
REFUSE(fmi3GetOutputDerivatives, (fmi3Instance instance, const fmi3ValueReference valueReferences[],
        size_t nValueReferences, const fmi3Int32 orders[], fmi3Float64 values[], size_t nValues))
REFUSE(fmi3ActivateModelPartition, (fmi3Instance instance, fmi3ValueReference clockReference,
        fmi3Float64 activationTime))
