/* $heading
 * $finding
 *
 * Written by `flasher conformance --export-test`. Build it with the sources of the bootloader and
 * its port, without flasher_dut_process.c (POSIX):
 *
 *     cc -g -fsanitize=address,undefined -I. THIS_FILE.c BOOTLOADER.c PORT.c -o test
 *
 * The good image runs at the beginning. Each frame below is given to the bootloader at its time, or
 * later, when as many answers have come as in the recording. The exit code is 0 when the device does
 * what is expected after the last frame, else 1. Limits of times are not checked. */
#define _DEFAULT_SOURCE

#include "flasher_dut.h"

#include <signal.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <sys/mman.h>
#include <sys/types.h>
#include <sys/wait.h>
#include <unistd.h>

#define EXPECTED $expected

enum {
    ANSWER_ID = $answer_id,
    BITRATE_BPS = $bitrate_bps,
    FLASH_BYTES = $flash_bytes,
    CHECK_IMAGE = $checks_image,      /* 1: `image` is in the flash and runs in the end */
    CHECK_STARTED = $checks_started,  /* 1: only `old_image` or `image` may be started */
    NONE = 255,
};
static const uint64_t patience_us = $patience_us; /* for an awaited answer */
static const uint64_t wait_us = $wait_us;         /* for answers to the last frame */

typedef struct {
    uint8_t size; /* 0: silence; NONE: end of the list */
    uint8_t bytes[$beginning_bytes];
} beginning;

/* The first answer to the last frame begins with one of these. */
static const beginning allowed[] = {
$allowed
};

/* No answer to the last frame begins with one of these. */
static const beginning forbidden[] = {
$forbidden
};

static const uint8_t image[] = {
$image
};

static const uint8_t old_image[] = {
$old_image
};

$flash
/* The flash at the beginning; what is not here is erased. */
static const struct {
    uint32_t offset, size;
    const uint8_t *bytes;
} flash[] = {
$flash_parts
};

typedef struct {
    uint64_t after_us; /* after the frame before */
    uint16_t answers;  /* messages of the device to await before */
    uint8_t is_reset;  /* 1: last frame of a reset, which the application obeys */
    flasher_frame frame;
} step;

static const step steps[] = {
$steps
};

enum { STEPS = sizeof steps / sizeof steps[0] };

/* -- the device: flash, CAN controller, clock, application ----------------------------------------
 *
 * Each start of the bootloader is a process of its own, so that RAM is lost, as in the suite. What
 * the processes share is in `world`. */

enum { FEEDBACK_COMMAND = 0x5503, RESTART_US = 10000, HANG_S = 10, STARTS_MAX = 1000 };
enum { ENDED = 0, STARTED_APPLICATION = 3, WAS_RESET = 4, FAILED = 5 };
enum { FRAME_BITS = 47, MESSAGE_MAX_BYTES = 264 };

typedef struct {
    uint64_t now;
    uint64_t arrived;      /* when the last frame to the device arrived */
    uint32_t next_step;
    uint32_t answers;      /* messages since then */
    int application;       /* runs */
    int is_allowed;        /* the first message after the last frame is one of `allowed` */
    int is_forbidden;      /* some message after it is one of `forbidden` */
    uint32_t waiting;      /* frames that arrived while the processor was busy */
    uint32_t size;         /* of the message that is being received */
    uint8_t message[MESSAGE_MAX_BYTES];
    char why[200];
    uint8_t memory[];      /* flash, then a byte for each unit: 1 when it was written */
} world;

static world *w;
static const flasher_dut_facts *facts;
static struct {
    flasher_frame frame;
    uint64_t left;
} sending[FLASHER_TRANSMIT_FRAMES];
static uint32_t sending_count;
static uint64_t wake;

_Noreturn static void failed(const char *why, uint32_t offset)
{
    snprintf(w->why, sizeof w->why, "%s (offset 0x%lX)", why, (unsigned long)offset);
    _exit(FAILED);
}

static uint8_t *written(uint32_t offset)
{
    return w->memory + facts->flash_bytes + offset / facts->write_bytes;
}

static int is_in_flash(uint32_t offset, uint32_t size)
{
    return offset <= facts->flash_bytes && size <= facts->flash_bytes - offset;
}

static int begins_with(const beginning *with)
{
    return w->size >= with->size && memcmp(w->message, with->bytes, with->size) == 0;
}

static void take_message(void)
{
    const uint32_t command = (uint32_t)w->message[4] << 8 | w->message[5];
    ++w->answers;
    if (w->next_step < STEPS || command == FEEDBACK_COMMAND)
        return;
    for (const beginning *one = allowed; one->size != NONE && w->is_allowed < 0; ++one)
        if (one->size > 0 && begins_with(one))
            w->is_allowed = 1;
    if (w->is_allowed < 0)
        w->is_allowed = 0;
    for (const beginning *one = forbidden; one->size != NONE; ++one)
        if (begins_with(one))
            w->is_forbidden = 1;
}

/* Frames that have left until now become messages. */
static void settle(void)
{
    while (sending_count > 0 && sending[0].left <= w->now) {
        const flasher_frame frame = sending[0].frame;
        memmove(sending, sending + 1, sizeof sending - sizeof sending[0]);
        --sending_count;
        if (frame.id != ANSWER_ID || frame.extended || frame.remote)
            continue;
        if (frame.length >= 2 && frame.data[0] == 0x55 && frame.data[1] == 0xAA)
            w->size = 0;
        for (uint32_t i = 0; i < frame.length && w->size < MESSAGE_MAX_BYTES; ++i)
            w->message[w->size++] = frame.data[i];
        if (w->size > 3 && w->size >= 9u + w->message[3]) {
            take_message();
            w->size = 0;
        }
    }
}

static uint64_t now_us(void)
{
    return w->now++;
}

static void flash_read(uint32_t offset, void *data, uint32_t size)
{
    if (!is_in_flash(offset, size))
        failed("flash_read outside of the flash", offset);
    memcpy(data, w->memory + offset, size);
}

static int flash_erase(uint32_t offset)
{
    if (!is_in_flash(offset, facts->sector_bytes) || offset % facts->sector_bytes)
        failed("flash_erase of no sector", offset);
    memset(w->memory + offset, 0xFF, facts->sector_bytes);
    memset(written(offset), 0, facts->sector_bytes / facts->write_bytes);
    w->now += facts->erase_us;
    return 0;
}

static int flash_write(uint32_t offset, const void *data, uint32_t size)
{
    const uint32_t unit = facts->write_bytes;
    if (!is_in_flash(offset, size) || offset % unit || size % unit || size == 0)
        failed("flash_write of no units", offset);
    for (uint32_t at = 0; at < size; at += unit) {
        if (*written(offset + at))
            failed("flash_write to flash that is not erased", offset + at);
        *written(offset + at) = 1;
    }
    memcpy(w->memory + offset, data, size);
    w->now += (uint64_t)size / unit * facts->write_us;
    return 0;
}

static uint32_t transmit_pending(void)
{
    return sending_count;
}

static void start_application(void)
{
    const uint8_t *runs = w->memory + facts->application_offset;
    settle();
    if (CHECK_STARTED && memcmp(runs, old_image, sizeof old_image) != 0 &&
        memcmp(runs, image, sizeof image) != 0)
        failed("start_application with a mixture in the flash", facts->application_offset);
    _exit(STARTED_APPLICATION);
}

static void reset(void)
{
    settle();
    _exit(WAS_RESET);
}

static void log_text(const char *text)
{
    fprintf(stderr, "log: %s\n", text);
}

static const flasher_host host = {
    now_us, flash_read, flash_erase, flash_write, transmit_pending, start_application, reset, log_text,
};

static void turn(void)
{
    flasher_frame frame;
    const uint64_t next = flasher_dut_tick(w->now);
    wake = next == UINT64_MAX || next > w->now ? next : w->now + 1000;
    settle();
    while (sending_count < FLASHER_TRANSMIT_FRAMES && flasher_dut_next_frame(&frame)) {
        const uint64_t begins = sending_count > 0 ? sending[sending_count - 1].left : w->now;
        const uint64_t bits = FRAME_BITS + 8u * frame.length;
        sending[sending_count].frame = frame;
        sending[sending_count++].left = begins + bits * 1000000u / BITRATE_BPS;
    }
}

static void run_until(uint64_t until)
{
    for (;;) {
        uint64_t due = wake;
        if (sending_count == FLASHER_TRANSMIT_FRAMES && sending[0].left < due)
            due = sending[0].left;
        if (due > until)
            break;
        if (w->now < due)
            w->now = due;
        settle();
        turn();
    }
    if (w->now < until)
        w->now = until;
    settle();
}

/* Gives the next frame to the bootloader at its time, later when awaited answers are late. */
static void take_step(void)
{
    const step *one = &steps[w->next_step];
    const uint64_t due = w->arrived + one->after_us;
    run_until(due);
    while (w->answers < one->answers && w->now < due + patience_us)
        run_until(w->now + 1000);
    w->waiting = w->now > due && one->answers == 0 ? w->waiting + 1 : 0;
    w->arrived = w->waiting ? due : w->now;
    w->answers = 0;
    ++w->next_step;
    if (w->waiting <= facts->receive_frames) {
        flasher_dut_receive(&one->frame);
        turn();
    }
}

_Noreturn static void run_bootloader(uint32_t cause)
{
    alarm(HANG_S);
    flasher_dut_start(&host, cause);
    turn();
    while (w->next_step < STEPS)
        take_step();
    run_until(w->arrived + wait_us);
    _exit(ENDED);
}

/* The application only answers a reset. Returns whether it was reset. */
static int run_application(void)
{
    while (w->next_step < STEPS) {
        const step *one = &steps[w->next_step++];
        w->arrived += one->after_us;
        w->answers = 0;
        if (one->is_reset) {
            w->answers = 1; /* general feedback */
            w->application = 0;
            w->now = w->arrived + RESTART_US;
            return 1;
        }
    }
    return 0;
}

static const char *run(void)
{
    uint32_t cause = FLASHER_RESET;
    for (uint32_t starts = 0; starts < STARTS_MAX; ++starts) {
        int status;
        if (w->application && !run_application())
            return "";
        const pid_t child = fork();
        if (child == 0)
            run_bootloader(cause);
        if (child < 0 || waitpid(child, &status, 0) < 0)
            return "this computer starts no process";
        if (WIFSIGNALED(status))
            return WTERMSIG(status) == SIGALRM ? "the bootloader hangs" : "the bootloader crashes";
        cause = FLASHER_RESET;
        w->size = 0;
        switch (WEXITSTATUS(status)) {
        case ENDED:
            return "";
        case STARTED_APPLICATION:
            w->application = 1;
            break;
        case WAS_RESET:
            w->now += RESTART_US;
            break;
        case FAILED:
            return w->why;
        default:
            return "the bootloader ends with an error, see above";
        }
    }
    return "the bootloader starts again and again";
}

static const char *verdict(void)
{
    int may_be_silent = allowed[0].size == NONE;
    const char *why = run();
    for (const beginning *one = allowed; one->size != NONE; ++one)
        may_be_silent |= one->size == 0;
    if (*why)
        return why;
    if (w->is_forbidden)
        return "the device answers as it did when this was recorded";
    if (allowed[0].size != NONE && w->is_allowed < 0 && !may_be_silent)
        return "no answer";
    if (allowed[0].size != NONE && w->is_allowed == 0)
        return "another answer";
    if (CHECK_IMAGE && memcmp(w->memory + facts->application_offset, image, sizeof image) != 0)
        return "the flash does not hold the image";
    if (CHECK_IMAGE && !w->application)
        return "the application does not run";
    return "";
}

/* 0 when the bootloader does what was expected. */
int flasher_exported_test(void)
{
    facts = flasher_dut_about();
    const size_t size = sizeof *w + facts->flash_bytes + facts->flash_bytes / facts->write_bytes;
    if (facts->flash_bytes != FLASH_BYTES) {
        printf("FAIL: written for a flash of %lu bytes\n", (unsigned long)FLASH_BYTES);
        return 1;
    }
    w = mmap(NULL, size, PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
    if (w == MAP_FAILED)
        return 2;
    memset(w, 0, sizeof *w);
    w->application = 1;
    w->is_allowed = -1;
    memset(w->memory, 0xFF, facts->flash_bytes);
    for (size_t i = 0; i < sizeof flash / sizeof flash[0]; ++i)
        memcpy(w->memory + flash[i].offset, flash[i].bytes, flash[i].size);
    for (uint32_t at = 0; at < facts->flash_bytes; ++at)
        if (w->memory[at] != 0xFF)
            *written(at) = 1;
    fflush(NULL);
    const char *why = verdict();
    if (*why)
        printf("FAIL: expected %s; got: %s\n", EXPECTED, why);
    else
        printf("PASS: %s\n", EXPECTED);
    const int code = *why != 0;
    munmap(w, size);
    return code;
}

#ifndef FLASHER_TEST_WITHOUT_MAIN
int main(void)
{
    return flasher_exported_test();
}
#endif
