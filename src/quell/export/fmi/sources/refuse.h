#ifndef REFUSE_H
#define REFUSE_H

#include "fmi3FunctionTypes.h"

/* Log that the FMU does not have the ability of a function, and return fmi3Error. */
fmi3Status refuse(fmi3Instance instance, const char *function);

#endif
