/* A controller in C against `pea emulate udp`, in real time: an integrator that holds 5 um. */
#include <math.h>
#include <stdio.h>

#include "pea_driver.h"

int main(int count, char **words)
{
    const double w = 5e-6, gain = 500e6, T_s = 50e-6; /* m, V/(m s), s */
    pea_options options = {"", 50000, 200000000, 5000000000, PEA_DRIVE, PEA_DEVICE};
    pea_sample sample;
    char error[128];
    options.address = count > 1 ? words[1] : "udp://127.0.0.1:20000";
    pea_device *device = pea_driver_open(&options, error, sizeof error);
    if (!device) {
        fprintf(stderr, "%s: %s\n", options.address, error);
        return 2;
    }
    double u = 0.0, e = 0.0;
    int code = pea_driver_exchange(device, u, PEA_HOLD | PEA_FRESH, &sample);
    for (int k = 0; k < 20000 && !code; k++) { /* one second */
        e = w - sample.y;
        u = fmin(fmax(u + gain * T_s * e, -20.0), 110.0);
        code = pea_driver_exchange(device, u, 0, &sample);
    }
    printf("error %.1f nm at %.2f V\n", e * 1e9, u);
    while (fabs(u) > 0.01 && !code) /* down softly */
        code = pea_driver_exchange(device, u *= 0.999, 0, &sample);
    pea_driver_safe(device, 0.0);
    pea_driver_close(device);
    return code;
}
