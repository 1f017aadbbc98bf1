/* LED controller of the sensor, for boards with an ATmega328P at 16 MHz (Arduino Uno, Nano).

   It answers requests on the serial port at 115200 baud, 8N1. docs/hardware/protocol.md describes the protocol.

   channel   Arduino pin   port   timer output
   0         D3            PD3    OC2B
   1         D5            PD5    OC0B
   2         D6            PD6    OC0A
   3         D11           PB3    OC2A

   A pin is high while its light is on. From a reset until the firmware runs, the pins are inputs. A resistor of 10 kOhm
   from each transistor's gate or base to ground keeps the lights off during that time.

   Three mechanisms turn the lights off. All lights are off after a boot. The watchdog of the protocol turns them off if
   no valid request arrives in time. The watchdog timer of the chip resets the board if the main loop or the clock
   stops. */

#include <avr/eeprom.h>
#include <avr/interrupt.h>
#include <avr/io.h>
#include <avr/pgmspace.h>
#include <avr/wdt.h>
#include <stdbool.h>
#include <stdint.h>
#include <stdio.h>
#include <string.h>
#include <util/atomic.h>
#include <util/crc16.h>
#include <util/delay.h>

#define BAUD 115200
#define BAUD_TOL 3
#include <util/setbaud.h>

#define FIRMWARE "1.0.0"
#define BOARD "atmega328p"
#define PROTOCOL 1
#define CHANNELS 4
#define LINE 64 /* longest line in bytes, with its newline */
#define LAST_SEQUENCE 65535
#define SHORTEST_WATCH_MS 100
#define LONGEST_WATCH_MS 10000
#define DEFAULT_WATCH_MS 1000

enum error { CHECKSUM = 1, COMMAND, ARGUMENTS, VERSION, LENGTH };

/* ---- EEPROM: the number of the boot, and the serial number ----------------------------------------------------- */

struct permanent {
    uint16_t boot;
    uint32_t serial;
    uint16_t check; /* checksum of `serial` */
};
static struct permanent EEMEM stored;
static uint16_t boot;
static char serial_number[17];

static uint16_t checksum(const char *text, uint8_t length)
{
    uint16_t crc = 0xFFFF;
    while (length--)
        crc = _crc_xmodem_update(crc, *text++);
    return crc;
}

#ifdef SERIAL_NUMBER

_Static_assert(sizeof(SERIAL_NUMBER) > 1 && sizeof(SERIAL_NUMBER) <= 17, "SERIAL must have 1 to 16 characters");

static void load_serial_number(void)
{
    strcpy_P(serial_number, PSTR(SERIAL_NUMBER));
}

#else

static volatile uint8_t samples;
static volatile uint32_t noise;

ISR(WDT_vect)
{
    noise = ((noise << 5) | (noise >> 27)) ^ TCNT1;
    samples++;
    WDTCSR |= _BV(WDIE); /* the interrupt has cleared WDIE, and without WDIE the next period ends in a reset */
}

/* Return a random number. The oscillator of the watchdog timer drifts against the crystal, so the crystal's cycle
   counts at the interrupts of the watchdog timer are random. */
static uint32_t random_number(void)
{
    TCCR1A = 0;
    TCCR1B = _BV(CS10);
    samples = 0;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        wdt_reset();
        WDTCSR = _BV(WDCE) | _BV(WDE);
        WDTCSR = _BV(WDE) | _BV(WDIE); /* an interrupt every 16 ms */
    }
    sei();
    while (samples < 32)
        ;
    cli();
    wdt_disable();
    TCCR1B = 0;
    TCNT1 = 0;
    return noise;
}

/* The first boot of a chip draws a random serial number and stores it in the EEPROM, where it survives flashing. */
static void load_serial_number(void)
{
    uint32_t serial = eeprom_read_dword(&stored.serial);
    if (eeprom_read_word(&stored.check) != checksum((const char *)&serial, sizeof serial)) {
        serial = random_number();
        eeprom_update_dword(&stored.serial, serial);
        eeprom_update_word(&stored.check, checksum((const char *)&serial, sizeof serial));
    }
    snprintf_P(serial_number, sizeof serial_number, PSTR("%08lX"), (unsigned long)serial);
}

#endif

static void count_boot(void)
{
    boot = eeprom_read_word(&stored.boot) + 1;
    eeprom_update_word(&stored.boot, boot);
}

/* ---- Clock ----------------------------------------------------------------------------------------------------- */

static volatile uint32_t milliseconds;

ISR(TIMER1_COMPA_vect)
{
    milliseconds++;
}

static void start_clock(void)
{
    OCR1A = F_CPU / 64 / 1000 - 1;
    TCCR1A = 0;
    TCCR1B = _BV(WGM12) | _BV(CS11) | _BV(CS10);
    TIMSK1 = _BV(OCIE1A);
}

static uint32_t uptime_ms(void)
{
    uint32_t now;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE) { now = milliseconds; }
    return now;
}

/* ---- Lights ---------------------------------------------------------------------------------------------------- */

static uint8_t levels[CHANNELS];
static uint32_t changes;

static void start_lights(void)
{
    PORTD &= ~(_BV(PD3) | _BV(PD5) | _BV(PD6));
    PORTB &= ~_BV(PB3);
    DDRD |= _BV(PD3) | _BV(PD5) | _BV(PD6);
    DDRB |= _BV(PB3);
    TCCR0A = _BV(WGM00); /* phase-correct PWM at 31 kHz: 255 is always on */
    TCCR2A = _BV(WGM20);
    TCCR0B = _BV(CS00);
    TCCR2B = _BV(CS20);
}

/* A level of 0 disconnects the pin from its timer, and the port holds the pin low. */
static void apply(const uint8_t wanted[CHANNELS])
{
    if (memcmp(levels, wanted, CHANNELS) == 0)
        return;
    memcpy(levels, wanted, CHANNELS);
    changes++;
    ATOMIC_BLOCK(ATOMIC_RESTORESTATE)
    {
        OCR2B = levels[0];
        OCR0B = levels[1];
        OCR0A = levels[2];
        OCR2A = levels[3];
        TCCR0A = _BV(WGM00) | (levels[2] ? _BV(COM0A1) : 0) | (levels[1] ? _BV(COM0B1) : 0);
        TCCR2A = _BV(WGM20) | (levels[3] ? _BV(COM2A1) : 0) | (levels[0] ? _BV(COM2B1) : 0);
    }
}

/* ---- Serial port ----------------------------------------------------------------------------------------------- */

#define RING 128 /* a power of two */
static volatile char ring[RING];
static volatile uint8_t ring_head, ring_tail;

/* A byte with a receive error becomes 0, and a byte that finds the buffer full is lost. The checksum reveals both. */
ISR(USART_RX_vect)
{
    uint8_t damaged = UCSR0A & (_BV(FE0) | _BV(DOR0) | _BV(UPE0));
    char byte = UDR0;
    uint8_t next = (ring_head + 1) % RING;
    if (next == ring_tail)
        return;
    ring[ring_head] = damaged ? 0 : byte;
    ring_head = next;
}

static void start_serial(void)
{
    UBRR0 = UBRR_VALUE;
#if USE_2X
    UCSR0A = _BV(U2X0);
#else
    UCSR0A = 0;
#endif
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXEN0) | _BV(TXEN0) | _BV(RXCIE0);
}

static bool received(char *byte)
{
    if (ring_tail == ring_head)
        return false;
    *byte = ring[ring_tail];
    ring_tail = (ring_tail + 1) % RING;
    return true;
}

static void transmit(const char *text)
{
    for (; *text; text++) {
        while (!(UCSR0A & _BV(UDRE0)))
            ;
        UDR0 = *text;
    }
}

/* ---- Protocol -------------------------------------------------------------------------------------------------- */

static char reply[LINE + 1];
static char answered[LINE]; /* the last request that was executed, whose answer is in `last_reply` */
static char last_reply[LINE + 1];
static uint32_t last_valid_ms;
static uint16_t watch_ms = DEFAULT_WATCH_MS;

/* Add the checksum to `reply` and send it. */
static void send_reply(void)
{
    uint8_t length = strlen(reply);
    snprintf_P(reply + length, sizeof reply - length, PSTR("*%04X\n"), checksum(reply, length));
    transmit(reply);
}

static void refuse(uint16_t sequence, enum error code)
{
    static const char texts[][12] PROGMEM = {"checksum", "command", "arguments", "protocol 1", "length"};
    _Static_assert(PROTOCOL == 1, "the text of VERSION names the protocol");
    snprintf_P(reply, sizeof reply, PSTR("%u ERR %u %S"), sequence, code, texts[code - 1]);
    send_reply();
}

/* Read a decimal number without sign and leading zeros. All numbers of requests have at most five digits. */
static bool number(const char *word, uint32_t least, uint32_t most, uint32_t *value)
{
    uint8_t digits = strlen(word);
    if (digits == 0 || digits > 5 || (digits > 1 && *word == '0'))
        return false;
    *value = 0;
    for (; *word; word++) {
        if (*word < '0' || *word > '9')
            return false;
        *value = *value * 10 + (*word - '0');
    }
    return least <= *value && *value <= most;
}

#define WORDS 7 /* one word more than the longest request has */

/* Execute a request and write its answer into `reply`. Returns 0 if the request was executed, else the error. */
static enum error execute(uint16_t sequence, uint8_t count, char *words[WORDS])
{
    const char *command = count > 1 ? words[1] : "";
    uint32_t value;
    if (strcmp_P(command, PSTR("HELLO")) == 0) {
        if (count != 3 || !number(words[2], 0, 65535, &value))
            return ARGUMENTS;
        if (value != PROTOCOL)
            return VERSION;
        snprintf_P(reply, sizeof reply, PSTR("%u OK HELLO %u " FIRMWARE " " BOARD " %s %u"), sequence, PROTOCOL,
                   serial_number, CHANNELS);
        return 0;
    }
    if (strcmp_P(command, PSTR("SET")) == 0) {
        uint8_t wanted[CHANNELS];
        if (count != 2 + CHANNELS)
            return ARGUMENTS;
        for (uint8_t i = 0; i < CHANNELS; i++) {
            if (!number(words[2 + i], 0, 255, &value))
                return ARGUMENTS;
            wanted[i] = value;
        }
        apply(wanted);
        snprintf_P(reply, sizeof reply, PSTR("%u OK SET %u %u %u %u %lu %u"), sequence, levels[0], levels[1],
                   levels[2], levels[3], (unsigned long)changes, boot);
        return 0;
    }
    if (strcmp_P(command, PSTR("PING")) == 0) {
        if (count != 2)
            return ARGUMENTS;
        snprintf_P(reply, sizeof reply, PSTR("%u OK PING %u %u %u %u %lu %u %lu"), sequence, levels[0], levels[1],
                   levels[2], levels[3], (unsigned long)changes, boot, (unsigned long)uptime_ms());
        return 0;
    }
    if (strcmp_P(command, PSTR("WATCH")) == 0) {
        if (count != 3 || !number(words[2], SHORTEST_WATCH_MS, LONGEST_WATCH_MS, &value))
            return ARGUMENTS;
        watch_ms = value;
        snprintf_P(reply, sizeof reply, PSTR("%u OK WATCH %u"), sequence, watch_ms);
        return 0;
    }
    return COMMAND;
}

/* Remove the checksum from a line. Returns false if the line is damaged. */
static bool checked(char *line)
{
    char expected[6];
    char *star = strchr(line, '*');
    if (star == NULL || star == line)
        return false;
    for (const char *byte = line; byte < star; byte++)
        if (*byte < ' ' || *byte > '~')
            return false;
    snprintf_P(expected, sizeof expected, PSTR("*%04X"), checksum(line, star - line));
    if (strcmp(star, expected) != 0)
        return false;
    *star = '\0';
    return true;
}

/* Answer one line, without its newline. */
static void answer(char *line)
{
    char request[LINE];
    char *words[WORDS];
    uint8_t count = 0;
    uint32_t sequence;
    enum error error;

    if (!checked(line)) {
        refuse(0, CHECKSUM);
        return;
    }
    if (strcmp(line, answered) == 0) { /* the host repeats the request: its answer was lost */
        last_valid_ms = uptime_ms();
        transmit(last_reply);
        return;
    }
    strcpy(request, line);
    for (char *rest = line; rest != NULL && count < WORDS;)
        words[count++] = strsep_P(&rest, PSTR(" "));
    if (!number(words[0], 1, LAST_SEQUENCE, &sequence)) {
        refuse(0, ARGUMENTS);
        return;
    }
    error = execute(sequence, count, words);
    if (error) {
        refuse(sequence, error);
        return;
    }
    last_valid_ms = uptime_ms();
    send_reply();
    strcpy(answered, request);
    strcpy(last_reply, reply);
}

/* Collect bytes until a newline. Empty lines are ignored. */
static void collect(char byte)
{
    static char line[LINE];
    static uint8_t length;
    static bool too_long;

    if (byte != '\n') {
        if (length == LINE - 1)
            too_long = true;
        else
            line[length++] = byte;
        return;
    }
    line[length] = '\0';
    if (too_long)
        refuse(0, LENGTH);
    else if (length > 0 && strlen(line) < length)
        refuse(0, CHECKSUM); /* a damaged byte */
    else if (length > 0)
        answer(line);
    length = 0;
    too_long = false;
}

/* Turn the lights off if no valid request has arrived for the watchdog's period. */
static void watch(void)
{
    static const uint8_t dark[CHANNELS];
    if (memcmp(levels, dark, CHANNELS) == 0 || uptime_ms() - last_valid_ms < watch_ms)
        return;
    apply(dark);
    snprintf_P(reply, sizeof reply, PSTR("0 OFF watchdog %lu"), (unsigned long)changes);
    send_reply();
}

/* After a reset by the watchdog timer, the timer continues with a period of 16 ms until it is stopped. */
void stop_watchdog_timer(void) __attribute__((naked, used, section(".init3")));
void stop_watchdog_timer(void)
{
    MCUSR = 0;
    wdt_disable();
}

int main(void)
{
    uint32_t kicked_ms = 0;
    char byte;

    start_lights();
    load_serial_number();
    count_boot();
    start_clock();
    start_serial();
    wdt_enable(WDTO_500MS);
    sei();
    transmit("\n"); /* ends a line that the bootloader may have begun */
    for (;;) {
        while (received(&byte)) {
            collect(byte);
            watch();
        }
        watch();
        if (uptime_ms() != kicked_ms) { /* the main loop and the clock both run */
            kicked_ms = uptime_ms();
            wdt_reset();
        }
    }
}
