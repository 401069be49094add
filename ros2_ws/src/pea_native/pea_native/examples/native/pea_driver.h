/* The driver of a device as a shared library, for loops that call no interpreter.
 *
 * A library defines the seven functions at the end of this file. `pea` loads it, sees that all of
 * them are there and of this version, and makes 1000 exchanges with the output held before it
 * commands anything. The compiled loop then calls `pea_driver_exchange` once a sample.
 *
 * Units are SI: volts at the actuator, metres, nanoseconds of CLOCK_MONOTONIC.
 *
 * Rules
 *   1. `pea_driver_open`, `_identify`, `_limits` and `_close` command nothing: the output stays
 *      where it is. They may take up to `connect_ns` and may allocate.
 *   2. `pea_driver_exchange` allocates nothing, takes no lock that another thread holds for long,
 *      and returns within `timeout_ns`, whatever the device does. A failure is a return value.
 *   3. u is never changed on the way: the safety gate in front of the library has limited it. A
 *      library that must limit it further returns PEA_REFUSED.
 *   4. `sample->u_applied` is what the device held until this sample, as the device says it, not
 *      the command.
 *   5. A library may be open twice: by the loop (PEA_DRIVE) and by the watchdog, another process
 *      (PEA_RESCUE), which calls nothing but `pea_driver_safe` and `pea_driver_close`, and only
 *      when the loop is dead or silent. Opening for PEA_RESCUE must not disturb the loop.
 *   6. `pea_driver_safe` commands u whatever was sent before, waits at most `timeout_ns`, and is
 *      safe to call again and again: the watchdog ramps with it.
 *   7. One thread calls at a time. Nothing is called after `pea_driver_close`.
 */
#ifndef PEA_DRIVER_H
#define PEA_DRIVER_H

#include <stddef.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define PEA_DRIVER_VERSION 1u

/* What pea_driver_exchange and pea_driver_safe return; from 64 on the library's own. */
enum {
    PEA_OK = 0,
    PEA_TIMEOUT = 1, /* no answer, or no new sample, within timeout_ns */
    PEA_WRONG = 2,   /* an answer that makes no sense */
    PEA_REFUSED = 3, /* the device does not take the command */
    PEA_LOST = 4     /* the device is gone */
};

enum { PEA_DRIVE = 0, PEA_RESCUE = 1 }; /* pea_options.role */

/* Who sets the pace, pea_options.pace.
 * PEA_CLOCK: the loop waits for its own deadline; an exchange commands u and returns the newest
 * sample. PEA_DEVICE: an exchange commands u and returns at the device's next sample; one that
 * has come already is returned at once, and none is left out as long as the device or the system
 * keeps it. `counter` then says what was lost. */
enum { PEA_CLOCK = 0, PEA_DEVICE = 1 };

/* Flags of pea_driver_exchange. */
enum {
    PEA_HOLD = 1, /* u says nothing: the output stays where it is */
    PEA_FRESH = 2 /* forget what has come already: return a sample that is taken from now on */
};

typedef struct pea_device pea_device; /* the library's own */

typedef struct {
    const char *address; /* driver.address of the rig's file */
    int64_t period_ns;   /* sample period of the loop */
    int64_t timeout_ns;  /* longest exchange */
    int64_t connect_ns;  /* longest pea_driver_open */
    uint32_t role;
    uint32_t pace;
} pea_options;

typedef struct {
    double voltage_min, voltage_max; /* V at the actuator */
    double y_min, y_max;             /* m */
} pea_limits;

typedef struct {
    double y;         /* displacement (m) at the sample */
    double u_applied; /* V held until the sample */
    uint64_t counter; /* number of the sample, one more for each that the device takes */
} pea_sample;

/* PEA_DRIVER_VERSION as the library was compiled with. */
uint32_t pea_driver_version(void);

/* The device, or NULL and one line of text why not in error[size]. */
pea_device *pea_driver_open(const pea_options *options, char *error, size_t size);

/* Who answered, in its own words, one line in text[size]. */
int pea_driver_identify(pea_device *device, char *text, size_t size);

int pea_driver_limits(pea_device *device, pea_limits *limits);

int pea_driver_exchange(pea_device *device, double u, uint32_t flags, pea_sample *sample);

int pea_driver_safe(pea_device *device, double u);

void pea_driver_close(pea_device *device);

#ifdef __cplusplus
}
#endif
#endif
