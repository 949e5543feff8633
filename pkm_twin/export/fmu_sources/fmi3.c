/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Functions of FMI 3.0 that take no instance. */
EXPORT const char *FMI(GetVersion)(void)
{
    return "3.0";
}

EXPORT void *FMI(InstantiateModelExchange)(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    void *environment, Logger log)
{
    (void)resources;
    (void)visible;
    (void)logging;
    return instantiate(name, token, log, environment);
}

EXPORT void *FMI(InstantiateCoSimulation)(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    bool event_mode, bool early, const Reference *required, size_t count, void *environment,
    Logger log, void (*intermediate)(void))
{
    (void)resources;
    (void)visible;
    (void)logging;
    (void)event_mode;
    (void)early;
    (void)required;
    (void)count;
    (void)intermediate;
    return instantiate(name, token, log, environment);
}

EXPORT void *FMI(InstantiateScheduledExecution)(
    const char *name, const char *token, const char *resources, bool visible, bool logging,
    void *environment, Logger log, void (*clock)(void), void (*lock)(void), void (*unlock)(void))
{
    (void)name;
    (void)token;
    (void)resources;
    (void)visible;
    (void)logging;
    (void)environment;
    (void)log;
    (void)clock;
    (void)lock;
    (void)unlock;
    return NULL;
}

EXPORT void FMI(FreeInstance)(void *instance)
{
    free(instance);
}

EXPORT Status FMI(SetDebugLogging)(void *instance, bool on, size_t count, const char *const *categories)
{
    (void)instance;
    (void)on;
    (void)count;
    (void)categories;
    return STATUS_OK;
}

EXPORT Status FMI(EnterInitializationMode)(void *instance, bool tolerant, double tolerance, double start, bool stops, double stop)
{
    Instance *c = (Instance *)instance;
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    c->model.v[0] = start;
    return enter(c, CREATED, INITIALISING);
}

EXPORT Status FMI(GetFloat64)(void *instance, const Reference *vr, size_t count, double *values, size_t size)
{
    Instance *c = (Instance *)instance;
    if (size != count) {
        return unsupported(c, 1);
    }
    return get_reals(c, vr, count, values);
}

EXPORT Status FMI(SetFloat64)(void *instance, const Reference *vr, size_t count, const double *values, size_t size)
{
    Instance *c = (Instance *)instance;
    if (size != count) {
        return unsupported(c, 1);
    }
    return set_reals(c, vr, count, values);
}

EXPORT Status FMI(GetInt32)(void *instance, const Reference *vr, size_t count, int32_t *values, size_t size)
{
    Instance *c = (Instance *)instance;
    if (size != count) {
        return unsupported(c, 1);
    }
    return get_status(c, vr, count, values);
}

EXPORT Status FMI(SetInt32)(void *instance, const Reference *vr, size_t count, const int32_t *values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    (void)size;
    return unsupported(c, count);
}

EXPORT Status FMI(GetBinary)(void *instance, const Reference *vr, size_t count, size_t *sizes, const unsigned char **values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)sizes;
    (void)values;
    (void)size;
    return unsupported(c, count);
}

EXPORT Status FMI(SetBinary)(void *instance, const Reference *vr, size_t count, const size_t *sizes, const unsigned char *const *values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)sizes;
    (void)values;
    (void)size;
    return unsupported(c, count);
}

EXPORT Status FMI(GetClock)(void *instance, const Reference *vr, size_t count, bool *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(SetClock)(void *instance, const Reference *vr, size_t count, const bool *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(GetNumberOfVariableDependencies)(void *instance, Reference vr, size_t *count)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)count;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetVariableDependencies)(void *instance, Reference vr, size_t *elements, Reference *independents, size_t *others, int *kinds, size_t count)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)elements;
    (void)independents;
    (void)others;
    (void)kinds;
    (void)count;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetDirectionalDerivative)(void *instance, const Reference *unknowns, size_t count, const Reference *knowns, size_t n, const double *seed, size_t seeds, double *values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)unknowns;
    (void)count;
    (void)knowns;
    (void)n;
    (void)seed;
    (void)seeds;
    (void)values;
    (void)size;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetAdjointDerivative)(void *instance, const Reference *unknowns, size_t count, const Reference *knowns, size_t n, const double *seed, size_t seeds, double *values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)unknowns;
    (void)count;
    (void)knowns;
    (void)n;
    (void)seed;
    (void)seeds;
    (void)values;
    (void)size;
    return unsupported(c, 1);
}

EXPORT Status FMI(EnterConfigurationMode)(void *instance)
{
    Instance *c = (Instance *)instance;
    return unsupported(c, 1);
}

EXPORT Status FMI(ExitConfigurationMode)(void *instance)
{
    Instance *c = (Instance *)instance;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetIntervalDecimal)(void *instance, const Reference *vr, size_t count, double *values, int *kinds)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    (void)kinds;
    return unsupported(c, count);
}

EXPORT Status FMI(GetIntervalFraction)(void *instance, const Reference *vr, size_t count, uint64_t *counters, uint64_t *resolutions, int *kinds)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)counters;
    (void)resolutions;
    (void)kinds;
    return unsupported(c, count);
}

EXPORT Status FMI(GetShiftDecimal)(void *instance, const Reference *vr, size_t count, double *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(GetShiftFraction)(void *instance, const Reference *vr, size_t count, uint64_t *counters, uint64_t *resolutions)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)counters;
    (void)resolutions;
    return unsupported(c, count);
}

EXPORT Status FMI(SetIntervalDecimal)(void *instance, const Reference *vr, size_t count, const double *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(SetShiftDecimal)(void *instance, const Reference *vr, size_t count, const double *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(SetIntervalFraction)(void *instance, const Reference *vr, size_t count, const uint64_t *counters, const uint64_t *resolutions)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)counters;
    (void)resolutions;
    return unsupported(c, count);
}

EXPORT Status FMI(SetShiftFraction)(void *instance, const Reference *vr, size_t count, const uint64_t *counters, const uint64_t *resolutions)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)counters;
    (void)resolutions;
    return unsupported(c, count);
}

EXPORT Status FMI(EvaluateDiscreteStates)(void *instance)
{
    (void)instance;
    return STATUS_OK;
}

EXPORT Status FMI(UpdateDiscreteStates)(void *instance, bool *need_update, bool *terminate, bool *nominals_changed, bool *values_changed, bool *time_defined, double *time)
{
    Instance *c = (Instance *)instance;
    int changed;
    const Status status = update(c, &changed);
    *need_update = *terminate = *nominals_changed = *time_defined = false;
    *values_changed = (changed != 0);
    *time = 0.0;
    return status;
}

EXPORT Status FMI(CompletedIntegratorStep)(void *instance, bool kept, bool *event_mode, bool *terminate)
{
    (void)instance;
    (void)kept;
    *event_mode = false;
    *terminate = false;
    return STATUS_OK;
}

EXPORT Status FMI(GetNumberOfEventIndicators)(void *instance, size_t *count)
{
    (void)instance;
    *count = DRY;
    return STATUS_OK;
}

EXPORT Status FMI(GetNumberOfContinuousStates)(void *instance, size_t *count)
{
    (void)instance;
    *count = STATES;
    return STATUS_OK;
}

EXPORT Status FMI(EnterStepMode)(void *instance)
{
    (void)instance;
    return STATUS_OK;
}

EXPORT Status FMI(GetOutputDerivatives)(void *instance, const Reference *vr, size_t count, const int32_t *orders, double *values, size_t size)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)orders;
    (void)values;
    (void)size;
    return unsupported(c, count);
}

EXPORT Status FMI(DoStep)(void *instance, double time, double span, bool kept, bool *event_needed, bool *terminate, bool *early, double *last)
{
    Instance *c = (Instance *)instance;
    (void)kept;
    const Status status = do_step(c, time, span);
    *event_needed = *terminate = *early = false;
    *last = (status == STATUS_OK) ? (time + span) : time;
    return status;
}

EXPORT Status FMI(ActivateModelPartition)(void *instance, Reference clock, double time)
{
    Instance *c = (Instance *)instance;
    (void)clock;
    (void)time;
    return unsupported(c, 1);
}

/* Getter and setter of a type that no variable of the model has. */
#define NO_ACCESS(name, type)                                                                                    \
EXPORT Status FMI(name)(void *instance, const Reference *vr, size_t count, type *values, size_t size)            \
{                                                                                                                \
    Instance *c = (Instance *)instance;                                                                          \
    (void)vr;                                                                                                    \
    (void)values;                                                                                                \
    (void)size;                                                                                                  \
    return unsupported(c, count);                                                                                \
}
#define NO_VARIABLES(kind, type) NO_ACCESS(Get##kind, type) NO_ACCESS(Set##kind, const type)

NO_VARIABLES(Float32, float)
NO_VARIABLES(Int8, int8_t)
NO_VARIABLES(UInt8, uint8_t)
NO_VARIABLES(Int16, int16_t)
NO_VARIABLES(UInt16, uint16_t)
NO_VARIABLES(UInt32, uint32_t)
NO_VARIABLES(Int64, int64_t)
NO_VARIABLES(UInt64, uint64_t)
NO_VARIABLES(Boolean, bool)
NO_VARIABLES(String, char *)
