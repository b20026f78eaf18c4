/* A bootloader written from the document alone, for tests.campaigns.right_devices: what the document
 * leaves open is a macro (`-DNAME=value`), and every value is right. Times are in microseconds.
 *
 * The whole flow is one function, `flow`, which reads like the document's figure 2: it goes on after
 * `WAIT` where it stopped, when a message or the time came.
 */
#include <string.h>

#include "choices.h"
#include "flasher_dut.h"
#include "store.h"

#define NEVER UINT64_MAX

enum { PACKET = 128, INBOX = 8, OUTBOX = 24, RING = 96, TEXT = 24 };

typedef enum {
    M_NONE,
    M_UPDATE,
    M_PACKET,
    M_END,
    M_RESET,
    M_WRITE,   /* another write */
    M_BAD,     /* a damaged message, or one that contradicts itself */
    M_PARTIAL, /* a message that stopped */
} kind_t;

typedef struct {
    kind_t kind;
    uint8_t serial; /* first byte of the command */
    uint8_t length; /* data bytes */
    uint8_t data[PACKET + 5];
} message_t;

typedef struct {
    uint64_t due;
    uint8_t size;
    uint8_t bytes[TEXT];
} answer_t;

static const flasher_host *hw;
static uint64_t now;

/* -- out ------------------------------------------------------------------------------------------ */

static flasher_frame ring[RING];
static uint32_t ring_head, ring_count;
static answer_t outbox[OUTBOX];
static uint32_t outbox_head, outbox_count;
static uint64_t answered_at; /* when the answer is due that was given last */

static uint32_t message_crc(uint32_t id, const uint8_t *body, uint32_t size)
{
    uint8_t head[4] = {0x55, 0xAA, (uint8_t)(id >> 8), (uint8_t)id};
    uint32_t reg = 0xFFFFFFFFu;
    for (uint32_t i = 0; i < size + 4; i++) {
        reg ^= i < 4 ? head[i] : body[i - 4];
        for (int bit = 0; bit < 32; bit++)
            reg = reg & 0x80000000u ? reg << 1 ^ 0x04C11DB7u : reg << 1;
    }
    return reg;
}

static void to_ring(const uint8_t *bytes, uint32_t size)
{
    if (ring_count + (size + 7) / 8 > RING)
        return; /* nobody takes frames from this bus */
    for (uint32_t at = 0; at < size; at += 8) {
        flasher_frame *frame = &ring[(ring_head + ring_count++) % RING];
        memset(frame, 0, sizeof *frame);
        frame->id = 0x705u + (NODE << 4);
        frame->length = (uint8_t)(size - at < 8 ? size - at : 8);
        memcpy(frame->data, bytes + at, frame->length);
    }
}

/* Sends a report `delay` from now, after the answers before it; at once when `delay` is 0. */
static void say(uint32_t command, const void *data, uint64_t delay)
{
    uint8_t text[TEXT] = {0x55, 0xAA, 0x0C, (uint8_t)((command & 0xFF) + 2), (uint8_t)(command >> 8), (uint8_t)command};
    uint32_t length = command & 0xFF, size = 6 + length;
    memcpy(text + 6, data, length);
    uint32_t crc = message_crc(0x705u + (NODE << 4), text + 2, size - 2);
    for (int i = 3; i >= 0; i--)
        text[size++] = (uint8_t)(crc >> 8 * i);
    text[size++] = 0xF0;
    if (delay == 0 && outbox_count == 0) {
        answered_at = now;
        to_ring(text, size);
    } else if (outbox_count < OUTBOX) {
        answer_t *answer = &outbox[(outbox_head + outbox_count++) % OUTBOX];
        uint64_t due = now + delay;
        answered_at = answer->due = due > answered_at ? due : answered_at;
        answer->size = (uint8_t)size;
        memcpy(answer->bytes, text, size);
    }
}

static void pump(void)
{
    while (outbox_count && outbox[outbox_head].due <= now) {
        to_ring(outbox[outbox_head].bytes, outbox[outbox_head].size);
        outbox_head = (outbox_head + 1) % OUTBOX;
        outbox_count--;
    }
}

static int all_sent(void)
{
    return !ring_count && !outbox_count && !hw->transmit_pending();
}

static void say_number(uint32_t command, uint32_t number, uint64_t delay)
{
    uint8_t data[2] = {(uint8_t)number, (uint8_t)(number >> 8)};
    say(command, data, delay);
}

static void nak(uint32_t number) { say_number(0xC302, number, NAK_US); }
static void request(void) { say_number(0xC402, 0, 0); }

/* Never waits for answers: the announcements keep their rhythm. */
static void announce(void)
{
    static const char *const names[] = {"", "WMC", "BMS", "PBU"};
    uint8_t data[9];
    uint32_t waiting = outbox_count;
    uint64_t kept = answered_at;
    memcpy(data, names[NODE], 3);
    memcpy(data + 3, BOOT_VERSION, 6);
    outbox_count = 0;
    say(0xC109, data, 0);
    outbox_count = waiting;
    answered_at = kept;
}

static void feedback(void)
{
    uint32_t waiting = outbox_count;
    uint64_t kept = answered_at;
    outbox_count = 0;
    say(0x5503, "ACK", 0);
    outbox_count = waiting;
    answered_at = kept;
}

/* -- in ------------------------------------------------------------------------------------------- */

static message_t inbox[INBOX];
static uint32_t inbox_head, inbox_count;
static uint8_t raw[264];
static uint32_t raw_size;
static uint64_t frame_at;

static message_t *post(kind_t kind)
{
    if (inbox_count == INBOX)
        inbox_count--; /* the last one gives way */
    message_t *message = &inbox[(inbox_head + inbox_count++) % INBOX];
    message->kind = kind;
    message->serial = raw_size > 4 ? raw[4] : 0;
    message->length = 0;
    if (raw_size > 6) {
        uint32_t length = raw_size - 6;
        message->length = (uint8_t)(length < sizeof message->data ? length : sizeof message->data);
        memcpy(message->data, raw + 6, message->length);
    }
    return message;
}

static void take_whole(uint32_t rest)
{
    uint32_t body = 4u + raw[3]; /* header to data */
    uint32_t crc = 0;
    for (uint32_t i = 0; i < 4; i++)
        crc = crc << 8 | raw[body + i];
    if (raw[body + 4] != 0xF0 || crc != message_crc(0x750u + NODE, raw + 2, body - 2) || raw[5] != raw[3] - 2 ||
        (rest && !PADDING_IGNORED)) {
        post(M_BAD);
        return;
    }
    if (raw[2] != 0x16)
        return; /* reads and reports do not concern a bootloader */
    uint32_t command = (uint32_t)raw[4] << 8 | raw[5];
    kind_t kind = M_WRITE;
    if (command == 0xA10B)
        kind = M_UPDATE;
    else if (command == 0xA385)
        kind = M_PACKET;
    else if (command == 0xA401)
        kind = M_END;
    else if (command == 0x4205 && !memcmp(raw + 6, "RESET", 5))
        kind = M_RESET;
    raw_size = body;
    post(kind);
}

void flasher_dut_receive(const flasher_frame *frame)
{
    if (frame->id != 0x750u + NODE || frame->extended || frame->remote || frame->length > 8)
        return;
    uint64_t at = hw->now_us();
    if (raw_size && at - frame_at > FRAME_GAP_US) {
        post(M_PARTIAL);
        raw_size = 0;
    }
    frame_at = at;
    int begun_here = 0;
    for (uint32_t i = 0; i < frame->length; i++) {
        uint8_t byte = frame->data[i];
        if (raw_size == 0) {
            if (byte == 0x55) {
                raw[raw_size++] = byte;
                begun_here = 1;
            } else if (JUNK_LOSES) {
                return;
            }
            continue;
        }
        if (raw_size == 1 && byte != 0xAA) {
            raw_size = byte == 0x55 && !JUNK_LOSES;
            if (JUNK_LOSES)
                return;
            continue;
        }
        raw[raw_size++] = byte;
        if (raw_size == 4 && raw[3] < 2) {
            post(M_BAD);
            raw_size = 0;
            if (!RESCANS)
                return;
            continue;
        }
        if (raw_size >= 4 && raw_size == 9u + raw[3]) {
            int wrong = raw[raw_size - 1] != 0xF0;
            take_whole(frame->length - i - 1);
            raw_size = 0;
            if (JUNK_LOSES || (wrong && !RESCANS))
                return;
        }
    }
    if (SHORT_FRAMES_REJECTED && raw_size && frame->length < 8 && (raw_size > 1 || begun_here)) {
        if (raw_size > 4)
            post(M_BAD);
        raw_size = 0;
    }
}

static const message_t *take(void)
{
    if (!inbox_count)
        return 0;
    const message_t *message = &inbox[inbox_head];
    inbox_head = (inbox_head + 1) % INBOX;
    inbox_count--;
    if ((message->kind == M_WRITE && FEEDBACK >= 1) || (message->kind == M_RESET && RESET_FEEDBACK))
        feedback();
    if ((message->kind == M_UPDATE || message->kind == M_PACKET || message->kind == M_END) && FEEDBACK >= 2)
        feedback();
    return message;
}

static uint32_t little(const uint8_t *data, uint32_t size)
{
    uint32_t value = 0;
    while (size--)
        value = value << 8 | data[size];
    return value;
}

/* The size that an update command asks for, 0 when it cannot be accepted. */
static uint32_t wanted(const message_t *message)
{
    static const char *const names[] = {"", "WMC_UPD", "BMS_UPD", "OBC_UPD"};
    if (message->kind != M_UPDATE || memcmp(message->data, names[NODE], 7))
        return 0;
    uint32_t size = little(message->data + 7, 4);
    return size <= LARGEST_BYTES ? size : 0;
}

/* -- the flow ------------------------------------------------------------------------------------- */

static int line;
static uint64_t wake;
static const message_t *got;

/* Goes on with the next message in `got`, or at the time `until` with 0 there. */
#define WAIT(until)                                                                                                    \
    do {                                                                                                               \
        wake = (until);                                                                                                \
        line = __LINE__; /* fall through */                                                                            \
    case __LINE__:                                                                                                     \
        got = take();                                                                                                  \
        if (!got && now < wake)                                                                                        \
            return;                                                                                                    \
    } while (0)

/* Goes on in the next pass of the main loop. */
#define PASS()                                                                                                         \
    do {                                                                                                               \
        wake = 0;                                                                                                      \
        line = __LINE__;                                                                                               \
        return;                                                                                                        \
    case __LINE__:;                                                                                                    \
    } while (0)

static uint64_t due;
static uint32_t announced, runnable, size, total, stored, again, step;

static int is_reset(int restarts)
{
    return got && got->kind == M_RESET && restarts;
}

static void refuse_update(void)
{
    if (UPDATE_NAK && got->kind == M_UPDATE)
        nak(0);
}

static uint32_t next_number(void)
{
    return stored == total && BEYOND_ASKS_LAST ? total : stored + 1;
}

/* Answers a packet that is damaged or makes no sense. */
static void answer_wrong(int is_damaged)
{
    int how = is_damaged ? DAMAGED_PACKET : WRONG_PACKET;
    if (how == 1)
        nak(next_number());
    if (how == 2)
        nak(got->length >= 3 ? little(got->data + 1, 2) : next_number());
}

static int take_packet(void)
{
    const uint8_t *data = got->data + 5;
    uint32_t number = little(got->data + 1, 2), left = size - stored * PACKET;
    uint32_t used = left < PACKET ? left : PACKET;
    if (got->data[0] != 1 || little(got->data + 3, 2) != total || number == 0 || number > stored + 1 || number > total) {
        answer_wrong(0);
        return 0;
    }
    if (number == stored) {
        if (REPEATED_NAKS_NEXT)
            nak(stored + 1);
        else
            say_number(0xC202, number, ACK_US);
        return 1;
    }
    if (number < stored) {
        if (OLDER_PACKET == 1)
            say_number(0xC202, number, ACK_US);
        if (OLDER_PACKET == 2)
            nak(next_number());
        if (OLDER_PACKET == 3)
            nak(number);
        return 1;
    }
    for (uint32_t i = used; FILLER_CHECKED && i < PACKET; i++)
        if (data[i] != 0xFF) {
            answer_wrong(0);
            return 0;
        }
    store_append(data, used, number == total);
    now = hw->now_us();
    if (store_failed() && WRITE_ERROR_NAKS) {
        nak(number);
        return 1;
    }
    stored++;
    say_number(0xC202, number, ACK_US);
    return 1;
}

static void flow(void)
{
    switch (line) {
    case 0:
        /* Begin, with what a power cut may have left to do. */
    begin:
        store_install();
        runnable = (uint32_t)store_is_runnable();
        now = hw->now_us();
        announced = size = 0;
        due = now + FIRST_US;

        /* Announce the boot version, and listen. */
        for (;;) {
            WAIT(due);
            if (got && is_reset(RESET_RESTARTS))
                goto restart;
            if (got && got->kind == M_UPDATE) {
                int deaf = announced < BURST && (announced ? BURST_HEARS == 0 : !HEARS_BEFORE);
                if (deaf && !DEAF_ANSWERS)
                    continue;
                if (deaf || !wanted(got))
                    refuse_update();
                else if (size == 0)
                    size = wanted(got);
            }
            if (size && (BURST_HEARS != 2 || announced == 0 || announced >= BURST))
                break;
            if (got)
                continue;
            if (announced < BURST || !runnable) {
                if (announced < BURST || ring_count == 0)
                    announce();
                announced++;
                due += SPACING_US;
                if (announced >= BURST && runnable)
                    due = now + WINDOW_US;
                else if (announced >= BURST && !size && LISTENS)
                    due = NEVER;
                else if (announced >= BURST && !size && announced % BURST == 0)
                    due += GAP_US;
                continue;
            }
            /* Nobody wants an upgrade: start the application. */
            due = now + START_US;
            do {
                WAIT(due);
                if (got && HEARS_LATE)
                    size = wanted(got);
                if (got && HEARS_LATE && !size)
                    refuse_update();
            } while (now < due && !size);
            if (size)
                break;
            due = now + 1000000;
            while (!all_sent() && now < due) {
                WAIT(now + 1000);
            }
            hw->start_application();
        }

        /* Erase, and request the transfer. */
    update:
        again = stored = 0;
        total = (size + PACKET - 1) / PACKET;
        due = now + REQUEST_US;
        if (store_begin(size))
            goto restart;
        for (step = 0; store_erase(step); step++)
            if (ERASE_IN_PASSES) {
                PASS();
                while ((got = take()) != 0) {
                    if (is_reset(RESET_RESTARTS_TRANSFER))
                        goto restart;
                    again += ERASING_HEARS && wanted(got) == size;
                }
            }
        if (store_failed())
            goto restart;
        now = hw->now_us();
        while (now < due) {
            WAIT(due);
            if (got && is_reset(RESET_RESTARTS_TRANSFER))
                goto restart;
            again += got && ERASING_HEARS && wanted(got) == size;
        }
        request();
        while (again && !ERASES_AGAIN) {
            request();
            again--;
        }
        if (again) {
            /* One erase and one request for each of these commands. */
            while (--again) {
                store_begin(size);
                for (step = 0; store_erase(step); step++)
                    ;
                now = hw->now_us();
                request();
            }
            goto update;
        }

        /* Receive packets. */
        due = now + PAUSE_US;
        for (;;) {
            WAIT(PAUSE_US ? due : NEVER);
            if (!got)
                goto restart;
            if (PAUSE_COUNTS == 0 && (got->serial == 0xA1 || got->serial == 0xA3 || got->serial == 0xA4))
                due = now + PAUSE_US;
            if (is_reset(RESET_RESTARTS_TRANSFER))
                goto restart;
            if (got->kind == M_PACKET) {
                if (take_packet() || PAUSE_COUNTS < 2)
                    due = now + PAUSE_US;
            } else if (got->kind == M_BAD) {
                if (got->serial == 0xA3 || (DAMAGED_ANY && got->serial != 0xA4))
                    answer_wrong(1);
                else if (got->serial == 0xA4 && DAMAGED_END_NAKS)
                    nak(next_number());
            } else if (got->kind == M_PARTIAL) {
                if (got->serial == 0xA3 && LOST_FRAME_NAKS)
                    nak(next_number());
            } else if (got->kind == M_UPDATE) {
                int first = stored == 0;
                if (!wanted(got) || (!first && !UPDATE_RESTARTS)) {
                    refuse_update();
                } else if (first && BEFORE_FIRST == 0) {
                    continue; /* one answer is right (R25) */
                } else if (first && BEFORE_FIRST == 1 && wanted(got) == size) {
                    request();
                    due = now + PAUSE_US;
                } else {
                    size = wanted(got);
                    goto update;
                }
            } else if (got->kind == M_END) {
                if (got->data[0] != 4) {
                    if (DAMAGED_END_NAKS)
                        nak(next_number());
                    continue;
                }
                if (stored == total)
                    break;
                say_number(0xC302, next_number(), NAK_US);
                if (EARLY_END_FAILS)
                    goto refused;
                due = now + PAUSE_US;
            }
        }

        /* Check what was received. */
        if (!store_finish()) {
            now = hw->now_us();
            say_number(0xC302, END_NAK == 0 ? 0 : END_NAK == 1 ? total : total + 1, END_NAK_US);
            goto refused;
        }
        now = hw->now_us();
        say_number(0xC502, 0, COMPLETE_US);
        due = answered_at + START_US;
        while (now < due || (!all_sent() && now < due + 10000000)) {
            WAIT(now < due ? due : now + 1000);
            if (got && got->kind == M_END && got->data[0] == 4 && END_ANSWERS_AGAIN && now >= answered_at)
                say_number(0xC502, 0, 0);
        }
        if (COMPLETE_RESTARTS)
            hw->reset();
        store_install();
        if (store_is_runnable())
            hw->start_application();
        hw->reset();

    refused:
        due = answered_at + REFUSED_US;
        while (now < due) {
            WAIT(due);
            if (got && got->kind == M_END && got->data[0] == 4 && END_ANSWERS_AGAIN && now >= answered_at)
                nak(next_number());
        }

    restart:
        due = now + 1000000;
        while (!all_sent() && now < due) {
            WAIT(now + 1000);
        }
        if (RESTART_BY_RESET)
            hw->reset();
        line = 0;
        goto begin;
    }
}

/* -- the interface -------------------------------------------------------------------------------- */

const flasher_dut_facts *flasher_dut_about(void)
{
    static const flasher_dut_facts facts = {
        .abi = FLASHER_DUT_ABI,
        .flash_bytes = FLASH_BYTES,
        .sector_bytes = SECTOR_BYTES,
        .write_bytes = WRITE_BYTES,
        .application_offset = APPLICATION_AT,
        .application_bytes = APPLICATION_BYTES,
        .erase_us = ERASE_US,
        .write_us = WRITE_US,
        .receive_frames = RECEIVE_FRAMES,
        .name = "right in C",
    };
    return &facts;
}

void flasher_dut_start(const flasher_host *host, uint32_t cause)
{
    (void)cause;
    hw = host;
    store_start(host);
}

uint64_t flasher_dut_tick(uint64_t now_us)
{
    now = now_us;
    if (raw_size && now - frame_at > FRAME_GAP_US) {
        post(M_PARTIAL);
        raw_size = 0;
    }
    pump();
    if (store_has_work() && !outbox_count && !ring_count) {
        store_work();
        now = hw->now_us();
    }
    flow();
    pump();
    uint64_t next = wake;
    if (store_has_work() && now + 1000 < next)
        next = now + 1000;
    if (outbox_count && outbox[outbox_head].due < next)
        next = outbox[outbox_head].due;
    if (raw_size && frame_at + FRAME_GAP_US + 1 < next)
        next = frame_at + FRAME_GAP_US + 1;
    return next;
}

int flasher_dut_next_frame(flasher_frame *frame)
{
    if (!ring_count)
        return 0;
    *frame = ring[ring_head];
    ring_head = (ring_head + 1) % RING;
    ring_count--;
    return 1;
}
