/* Main program for a bootloader that implements flasher_dut.h: link both, and test the program by
 * `flasher conformance --subject`. It talks to the suite on standard input and output; output of
 * the bootloader goes to standard error.
 *
 * Each message is a header of 8 bytes (type, three zeros, size of the rest as uint32) and the rest;
 * integers are little-endian, frames have the memory layout of `flasher_frame`.
 *
 *   program to suite, first:   'f' facts: nine uint32 in the order of flasher_dut_facts, name
 *   suite to program:          'S' start: uint64 now, uint32 cause
 *                              'R' received: uint64 now, uint32 pending, frame
 *                              'T' tick: uint64 now, uint32 pending, uint64 until: no frame comes
 *                                  until then, so idle passes are repeated here (missing where
 *                                  the ABI is 1)
 *   program to suite, during:  'r' read: uint32 offset, uint32 size; answered by 'd' data
 *                              'e' erase: uint64 now, uint32 offset; answered by 'k' uint64 now,
 *                                  uint32 error (0: none; missing where the ABI is 1)
 *                              'w' write: uint64 now, uint32 offset, data; answered by 'k'
 *                              'l' log: text
 *                              'a' start the application, 'z' reset: uint64 start of the pass; end
 *                                  the program
 *   program to suite, at last: '.' done: uint64 now, uint64 next tick, frames to send
 */
#define _POSIX_C_SOURCE 200809L

#include "flasher_dut.h"

#include <stdlib.h>
#include <string.h>
#include <sys/uio.h>
#include <unistd.h>

#if __BYTE_ORDER__ != __ORDER_LITTLE_ENDIAN__
#error "written for little-endian computers"
#endif

static int to_suite;
static uint64_t now;
static uint64_t pass_began;
static uint32_t pending;
static int is_idle; /* nothing was sent to the suite in this pass */

static uint8_t received[4096];
static size_t received_at, received_end;

static void read_exactly(void *data, size_t size)
{
    uint8_t *at = data;
    while (size > 0) {
        if (received_at == received_end) {
            ssize_t got = read(STDIN_FILENO, received, sizeof received);
            if (got <= 0)
                _exit(0); /* the suite has ended */
            received_at = 0;
            received_end = (size_t)got;
        }
        size_t part = received_end - received_at < size ? received_end - received_at : size;
        memcpy(at, received + received_at, part);
        received_at += part;
        at += part;
        size -= part;
    }
}

typedef struct {
    uint8_t type;
    uint8_t zeros[3];
    uint32_t size;
} header;

#ifdef FLASHER_DUT_COVERAGE
/* The suite may kill this program after any message that ends a call: counts are written before. */
void __gcov_dump(void);
void __gcov_reset(void);
static void write_coverage(uint8_t type)
{
    if (type == '.' || type == 'a' || type == 'z') {
        __gcov_dump();
        __gcov_reset();
    }
}
#else
#define write_coverage(type) (void)(type)
#endif

/* A message of two parts. */
static void tell(uint8_t type, const void *one, size_t one_size, const void *two, size_t two_size)
{
    write_coverage(type);
    is_idle = 0;
    const header head = {type, {0, 0, 0}, (uint32_t)(one_size + two_size)};
    const struct iovec parts[] = {
        {(void *)&head, sizeof head}, {(void *)one, one_size}, {(void *)two, two_size}};
    if (writev(to_suite, parts, 3) != (ssize_t)(sizeof head + head.size))
        _exit(0); /* the suite has ended */
}

static uint32_t next_message(uint8_t *type)
{
    header head;
    read_exactly(&head, sizeof head);
    *type = head.type;
    return head.size;
}

/* -- the hardware ----------------------------------------------------------------------------- */

static uint64_t now_us(void)
{
    return now++; /* so that a loop that polls the time ends */
}

static void flash_read(uint32_t offset, void *data, uint32_t size)
{
    uint8_t type;
    const uint32_t request[2] = {offset, size};
    tell('r', request, sizeof request, NULL, 0);
    if (next_message(&type) != size)
        abort();
    read_exactly(data, size);
}

static int flash_result(void)
{
    uint8_t type;
    uint32_t error;
    if (next_message(&type) != sizeof now + sizeof error)
        abort();
    read_exactly(&now, sizeof now);
    read_exactly(&error, sizeof error);
    return error != 0;
}

typedef struct {
    uint64_t now;
    uint32_t offset;
} flash_place;

enum { FLASH_PLACE_BYTES = 12 };

static int flash_erase(uint32_t offset)
{
    const flash_place place = {now, offset};
    tell('e', &place, FLASH_PLACE_BYTES, NULL, 0);
    return flash_result();
}

static int flash_write(uint32_t offset, const void *data, uint32_t size)
{
    const flash_place place = {now, offset};
    tell('w', &place, FLASH_PLACE_BYTES, data, size);
    return flash_result();
}

static uint32_t transmit_pending(void)
{
    return pending;
}

static void start_application(void)
{
    tell('a', &pass_began, sizeof pass_began, NULL, 0);
    _exit(0);
}

static void reset(void)
{
    tell('z', &pass_began, sizeof pass_began, NULL, 0);
    _exit(0);
}

static void log_text(const char *text)
{
    tell('l', text, strlen(text), NULL, 0);
}

static const flasher_host host = {
    now_us, flash_read, flash_erase, flash_write, transmit_pending, start_application, reset, log_text,
};

/* -- the suite's calls ------------------------------------------------------------------------ */

/* A pass of the main loop, and further ones until `until` as long as nothing happens in them. */
static void turn(uint64_t until)
{
    flasher_frame frames[FLASHER_TRANSMIT_FRAMES];
    size_t count = 0;
    uint64_t times[2];
    for (;;) {
        is_idle = 1;
        times[1] = flasher_dut_tick(now);
        while (pending + count < FLASHER_TRANSMIT_FRAMES && flasher_dut_next_frame(&frames[count]))
            ++count;
        const uint64_t next = times[1] > now ? times[1] : now + 1000;
        if (!is_idle || count > 0 || next > until)
            break;
        pass_began = now = next;
    }
    times[0] = now;
    tell('.', times, sizeof times, frames, count * sizeof frames[0]);
}

int main(void)
{
    const flasher_dut_facts *facts = flasher_dut_about();
    to_suite = dup(STDOUT_FILENO);
    dup2(STDERR_FILENO, STDOUT_FILENO);
    const char *name = facts->name ? facts->name : "";
    tell('f', facts, 9 * sizeof(uint32_t), name, strlen(name));
    for (;;) {
        uint8_t type;
        flasher_frame frame;
        uint32_t number;
        uint64_t until = 0;
        uint32_t size = next_message(&type);
        read_exactly(&now, sizeof now);
        read_exactly(&number, sizeof number);
        pass_began = now;
        if (size == sizeof now + sizeof number + sizeof until)
            read_exactly(&until, sizeof until);
        if (size == sizeof now + sizeof number + sizeof frame)
            read_exactly(&frame, sizeof frame);
        if (type == 'S') {
            flasher_dut_start(&host, number);
        } else {
            pending = number;
            if (type == 'R')
                flasher_dut_receive(&frame);
        }
        turn(until);
    }
}
