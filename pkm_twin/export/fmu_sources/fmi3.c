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
