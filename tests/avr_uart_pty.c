/* Runs the firmware in the simulator of its chip, no faster than real time, with its UART on a pseudo-terminal.

   Usage: avr_uart_pty FIRMWARE.hex. It prints the name of the pseudo-terminal, and then the duty cycles of the four
   channels whenever they change, read from the registers of the timers: "levels 0 0 0 0". It takes single letters on
   standard input: r resets the chip, s stops the firmware's clock, and the end of the input ends the program. */

#define _GNU_SOURCE
#include <fcntl.h>
#include <poll.h>
#include <simavr/avr_uart.h>
#include <simavr/sim_avr.h>
#include <simavr/sim_hex.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <termios.h>
#include <time.h>
#include <unistd.h>

/* Data addresses of the ATmega328P. */
enum { TCCR0A = 0x44, OCR0A = 0x47, OCR0B = 0x48, TCCR2A = 0xB0, OCR2A = 0xB3, OCR2B = 0xB4, TIMSK1 = 0x6F };
enum { COM_A = 0x80, COM_B = 0x20 };

static int terminal, blocked;

static void from_chip(avr_irq_t *irq, uint32_t value, void *unused)
{
    uint8_t byte = value;
    (void)irq, (void)unused;
    if (write(terminal, &byte, 1) != 1)
        perror("write to the pseudo-terminal");
}

static void full(avr_irq_t *irq, uint32_t value, void *now)
{
    (void)irq, (void)value;
    blocked = now != NULL;
}

static double seconds(void)
{
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec + 1e-9 * now.tv_nsec;
}

static void print_levels(const uint8_t *data)
{
    static char shown[64];
    char line[64];
    snprintf(line, sizeof line, "levels %d %d %d %d", data[TCCR2A] & COM_B ? data[OCR2B] : 0,
             data[TCCR0A] & COM_B ? data[OCR0B] : 0, data[TCCR0A] & COM_A ? data[OCR0A] : 0,
             data[TCCR2A] & COM_A ? data[OCR2A] : 0);
    if (strcmp(line, shown) != 0)
        puts(strcpy(shown, line));
}

int main(int argc, char *argv[])
{
    uint32_t size, start_address;
    avr_t *avr = avr_make_mcu_by_name("atmega328p");
    uint8_t *code = argc == 2 ? read_ihex_file(argv[1], &size, &start_address) : NULL;
    if (code == NULL || avr == NULL)
        return 2;
    avr_init(avr);
    avr->frequency = 16000000;
    avr->log = LOG_ERROR;
    avr_loadcode(avr, code, size, start_address);
    avr->codeend = avr->flashend;

    terminal = posix_openpt(O_RDWR | O_NOCTTY | O_NONBLOCK);
    if (terminal < 0 || grantpt(terminal) != 0 || unlockpt(terminal) != 0)
        return 2;
    int slave = open(ptsname(terminal), O_RDWR | O_NOCTTY); /* stays open, so that the host may come and go */
    struct termios mode;
    tcgetattr(slave, &mode);
    cfmakeraw(&mode);
    tcsetattr(slave, TCSANOW, &mode);

    uint32_t flags = 0;
    avr_ioctl(avr, AVR_IOCTL_UART_SET_FLAGS('0'), &flags);
    avr_irq_t *uart = avr_io_getirq(avr, AVR_IOCTL_UART_GETIRQ('0'), 0);
    avr_irq_register_notify(uart + UART_IRQ_OUTPUT, from_chip, NULL);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XON, full, NULL);
    avr_irq_register_notify(uart + UART_IRQ_OUT_XOFF, full, &blocked);

    setvbuf(stdout, NULL, _IOLBF, 0);
    puts(ptsname(terminal));
    double start = seconds();
    avr_cycle_count_t done = 0; /* cycles since the start, over all resets */
    for (;;) {
        avr_cycle_count_t before = avr->cycle, until = before + 16000; /* one millisecond */
        while (avr->cycle >= before && avr->cycle < until) {
            int state = avr_run(avr);
            if (state == cpu_Done || state == cpu_Crashed)
                return 3;
        }
        done += 16000;
        print_levels(avr->data);
        uint8_t byte;
        for (int i = 0; i < 11 && !blocked && read(terminal, &byte, 1) == 1; i++) /* 115200 baud */
            avr_raise_irq(uart + UART_IRQ_INPUT, byte);

        struct pollfd input = {.fd = STDIN_FILENO, .events = POLLIN};
        char letter;
        if (poll(&input, 1, 0) > 0) {
            if (read(STDIN_FILENO, &letter, 1) != 1)
                return 0;
            if (letter == 'r')
                avr_reset(avr);
            else if (letter == 's')
                avr->data[TIMSK1] = 0;
        }
        double ahead = start + done / 16e6 - seconds();
        if (ahead > 0)
            usleep(ahead * 1e6);
        else
            start -= ahead; /* a busy machine: simulated time is slower */
    }
}
