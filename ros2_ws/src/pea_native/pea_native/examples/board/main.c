/* A board with a stage in it, as a process: board ADDRESS [PERIOD_NS [CPU]].
 *
 * The stage is Eq 1 of the paper, second order, with a backlash of 4 V in place of hysteresis. On
 * a real board the sensor's converter and the amplifier's take the place of `stage`.
 */
#include <errno.h>
#include <math.h>
#include <sched.h>
#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <time.h>

#include "pea_board.h"

static volatile sig_atomic_t ended;

static void end(int number)
{
    (void)number;
    ended = 1;
}

static double stage(double u, double T)
{
    const double zeta = 0.8, omega = 2900.0, K = 0.142e-6, play = 2.0;
    static double x, v, at;
    at = fmin(fmax(at, u - play), u + play);
    for (int i = 0; i < 4; i++) { /* semi-implicit steps of a quarter of a period */
        v += T / 4 * omega * omega * (K * at - x) - T / 4 * 2 * zeta * omega * v;
        x += T / 4 * v;
    }
    return x;
}

int main(int count, char **words)
{
    if (count < 2) {
        fprintf(stderr, "usage: board udp://HOST:PORT|FILE [PERIOD_NS [CPU]]\n");
        return 2;
    }
    int64_t period = count > 2 ? atoll(words[2]) : 50000, missed = 0;
    if (period < 10000 || period > 1000000000) {
        fprintf(stderr, "PERIOD_NS %s: give 10000 to 1000000000\n", words[2]);
        return 2;
    }
    if (count > 3) {
        cpu_set_t core;
        CPU_ZERO(&core);
        CPU_SET(atoi(words[3]), &core);
        sched_setaffinity(0, sizeof core, &core);
    }
    prctl(PR_SET_TIMERSLACK, 1);
    sched_setscheduler(0, SCHED_FIFO, &(struct sched_param){80}); /* where permitted */
    mlockall(MCL_CURRENT | MCL_FUTURE);
    signal(SIGINT, end);
    signal(SIGTERM, end);
    char error[256];
    pea_board_setup setup = {words[1], "board", period, -20.0, 130.0, -5e-6, 20e-6};
    pea_board *board = pea_board_open(&setup, error, sizeof error);
    if (!board) {
        fprintf(stderr, "%s\n", error);
        return 2;
    }
    if (pea_board_port(board))
        printf("port %d\n", pea_board_port(board));
    fflush(stdout);
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    int64_t due = t.tv_sec * INT64_C(1000000000) + t.tv_nsec;
    double u = 0.0, y = 0.0, low = 0.0, high = 0.0;
    for (uint64_t k = 1; !ended; k++) {
        due += period;
        double command = pea_board_wait(board, due);
        pea_board_give(board, k, y, u, 0);
        u = command;
        y = stage(u, period * 1e-9);
        low = fmin(low, u);
        high = fmax(high, u);
        clock_gettime(CLOCK_MONOTONIC, &t);
        missed += t.tv_sec * INT64_C(1000000000) + t.tv_nsec > due + period;
    }
    printf("{\"commands\": %lld, \"missed\": %lld, \"min_V\": %g, \"max_V\": %g}\n",
           (long long)pea_board_commands(board), (long long)missed, low, high);
    pea_board_close(board);
    return 0;
}
