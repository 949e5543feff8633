/* Copyright 2026 pkm_twin maintainers. SPDX-License-Identifier: Apache-2.0 */
/* Functions of FMI 2.0 that take no instance. */
EXPORT const char *FMI(GetTypesPlatform)(void)
{
    return "default";
}

EXPORT const char *FMI(GetVersion)(void)
{
    return "2.0";
}

EXPORT void *FMI(Instantiate)(
    const char *name, int kind, const char *token, const char *resources,
    const Callbacks *callbacks, int visible, int logging)
{
    (void)kind;
    (void)resources;
    (void)visible;
    (void)logging;
    return instantiate(name, token, (callbacks != NULL) ? callbacks->logger : NULL,
        (callbacks != NULL) ? callbacks->environment : NULL);
}

EXPORT void FMI(FreeInstance)(void *instance)
{
    free(instance);
}

EXPORT Status FMI(SetDebugLogging)(void *instance, int on, size_t count, const char *const *categories)
{
    (void)instance;
    (void)on;
    (void)count;
    (void)categories;
    return STATUS_OK;
}

EXPORT Status FMI(SetupExperiment)(void *instance, int tolerant, double tolerance, double start, int stops, double stop)
{
    Instance *c = (Instance *)instance;
    (void)tolerant;
    (void)tolerance;
    (void)stops;
    (void)stop;
    c->model.v[0] = start;
    return STATUS_OK;
}

EXPORT Status FMI(EnterInitializationMode)(void *instance)
{
    return enter((Instance *)instance, CREATED, INITIALISING);
}

EXPORT Status FMI(GetReal)(void *instance, const Reference *vr, size_t count, double *values)
{
    Instance *c = (Instance *)instance;
    return get_reals(c, vr, count, values);
}

EXPORT Status FMI(SetReal)(void *instance, const Reference *vr, size_t count, const double *values)
{
    Instance *c = (Instance *)instance;
    return set_reals(c, vr, count, values);
}

EXPORT Status FMI(GetInteger)(void *instance, const Reference *vr, size_t count, int *values)
{
    Instance *c = (Instance *)instance;
    return get_status(c, vr, count, values);
}

EXPORT Status FMI(SetInteger)(void *instance, const Reference *vr, size_t count, const int *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(GetDirectionalDerivative)(void *instance, const Reference *unknowns, size_t count, const Reference *knowns, size_t n, const double *seed, double *values)
{
    Instance *c = (Instance *)instance;
    (void)unknowns;
    (void)count;
    (void)knowns;
    (void)n;
    (void)seed;
    (void)values;
    return unsupported(c, 1);
}

EXPORT Status FMI(NewDiscreteStates)(void *instance, EventInfo *info)
{
    Instance *c = (Instance *)instance;
    memset(info, 0, sizeof *info);
    return update(c, &info->values_changed);
}

EXPORT Status FMI(CompletedIntegratorStep)(void *instance, int kept, int *event_mode, int *terminate)
{
    (void)instance;
    (void)kept;
    *event_mode = 0;
    *terminate = 0;
    return STATUS_OK;
}

EXPORT Status FMI(SetRealInputDerivatives)(void *instance, const Reference *vr, size_t count, const int *orders, const double *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)orders;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(GetRealOutputDerivatives)(void *instance, const Reference *vr, size_t count, const int *orders, double *values)
{
    Instance *c = (Instance *)instance;
    (void)vr;
    (void)orders;
    (void)values;
    return unsupported(c, count);
}

EXPORT Status FMI(DoStep)(void *instance, double time, double span, int kept)
{
    Instance *c = (Instance *)instance;
    (void)kept;
    return do_step(c, time, span);
}

EXPORT Status FMI(CancelStep)(void *instance)
{
    Instance *c = (Instance *)instance;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetStatus)(void *instance, int kind, Status *value)
{
    Instance *c = (Instance *)instance;
    (void)kind;
    (void)value;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetRealStatus)(void *instance, int kind, double *value)
{
    Instance *c = (Instance *)instance;
    if (kind != 2) {
        return unsupported(c, 1);
    }
    *value = c->model.v[0];
    return STATUS_OK;
}

EXPORT Status FMI(GetIntegerStatus)(void *instance, int kind, int *value)
{
    Instance *c = (Instance *)instance;
    (void)kind;
    (void)value;
    return unsupported(c, 1);
}

EXPORT Status FMI(GetBooleanStatus)(void *instance, int kind, int *value)
{
    Instance *c = (Instance *)instance;
    if (kind != 3) {
        return unsupported(c, 1);
    }
    *value = 0;
    return STATUS_OK;
}

EXPORT Status FMI(GetStringStatus)(void *instance, int kind, const char **value)
{
    Instance *c = (Instance *)instance;
    (void)kind;
    (void)value;
    return unsupported(c, 1);
}

/* Getter and setter of a type that no variable of the model has. */
#define NO_VARIABLES(kind, type)                                                                    \
EXPORT Status FMI(Get##kind)(void *instance, const Reference *vr, size_t count, type *values)       \
{                                                                                                   \
    Instance *c = (Instance *)instance;                                                             \
    (void)vr;                                                                                       \
    (void)values;                                                                                   \
    return unsupported(c, count);                                                                   \
}                                                                                                   \
EXPORT Status FMI(Set##kind)(void *instance, const Reference *vr, size_t count, const type *values) \
{                                                                                                   \
    Instance *c = (Instance *)instance;                                                             \
    (void)vr;                                                                                       \
    (void)values;                                                                                   \
    return unsupported(c, count);                                                                   \
}

NO_VARIABLES(Boolean, int)
NO_VARIABLES(String, char *)
