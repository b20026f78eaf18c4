#include "boot.h"

#include "config.h"
#include "crc.h"
#include "message.h"
#include "store.h"

#if TARGET == TARGET_WMC
#define OWN_NAME "WMC"
#define UPDATE_NAME "WMC_UPD"
#elif TARGET == TARGET_BMS
#define OWN_NAME "BMS"
#define UPDATE_NAME "BMS_UPD"
#elif TARGET == TARGET_OBC
#define OWN_NAME "PBU"
#define UPDATE_NAME "OBC_UPD"
#else
#error "TARGET is none of those in config.h"
#endif

enum {
    ID_RECEIVED = 0x750 + TARGET,
    ID_SENT = 0x705 + 0x10 * TARGET,
    COMMAND_RESET = 0x4205,
    COMMAND_UPDATE = 0xA10B,
    COMMAND_PACKET = 0xA385,
    COMMAND_END = 0xA401,
    REPORT_VERSION = 0xC109,
    REPORT_ACK = 0xC202,
    REPORT_NAK = 0xC302,
    REPORT_REQUEST = 0xC402,
    REPORT_COMPLETE = 0xC502,
    SOH = 0x01,
    EOT = 0x04,
    VERSIONS = 4,
    VERSION_SPACING_MS = 50,
    REPORT_MAX_BYTES = 20,
    QUEUE_FRAMES = 16,
};

_Static_assert(sizeof BOOT_VERSION == 7, "BOOT_VERSION has the form Vx.x.x");

typedef enum {
    ANNOUNCING, /* until an update command comes; due: the next version, or the window's end */
    ERASING,    /* one sector per pass */
    TRANSFER,   /* due: the end of the longest pause */
    STARTING,   /* the application starts when the last frames have left, or when due */
    RESTARTING, /* likewise, with a reset */
} phase;

static struct {
    phase phase;
    uint32_t due_ms;
    bool has_application;
    uint8_t versions; /* sent in this burst */

    uint32_t erase_step;
    uint32_t size; /* of the image, from the update command */
    uint32_t crc;  /* of the stored packets */
    uint16_t packets;
    uint16_t next; /* next packet, from 1; packets + 1 when all are stored */

    message_receiver receiver;
    can_frame queue[QUEUE_FRAMES];
    uint8_t queue_first;
    uint8_t queued;
} boot;

/* -- sending ---------------------------------------------------------------------------------- */

/* Drops a message when the queue is full: no node acknowledges frames, and the tool repeats. */
static void report(uint16_t command, const uint8_t *data)
{
    uint8_t bytes[REPORT_MAX_BYTES];
    const uint16_t size = message_make(bytes, ID_SENT, MODE_REPORT, command, data);
    if (QUEUE_FRAMES - boot.queued < (size + 7) / 8)
        return;
    for (uint16_t at = 0; at < size; at = (uint16_t)(at + 8)) {
        can_frame *frame = &boot.queue[(boot.queue_first + boot.queued++) % QUEUE_FRAMES];
        frame->id = ID_SENT;
        frame->extended = false;
        frame->remote = false;
        frame->length = (uint8_t)(size - at < 8 ? size - at : 8);
        for (uint8_t i = 0; i < frame->length; ++i)
            frame->data[i] = bytes[at + i];
    }
}

static void report_number(uint16_t command, uint16_t number)
{
    const uint8_t data[2] = {(uint8_t)number, (uint8_t)(number >> 8)};
    report(command, data);
}

bool boot_next_frame(can_frame *frame)
{
    if (boot.queued == 0)
        return false;
    *frame = boot.queue[boot.queue_first];
    boot.queue_first = (uint8_t)((boot.queue_first + 1) % QUEUE_FRAMES);
    --boot.queued;
    return true;
}

/* -- phases ----------------------------------------------------------------------------------- */

static void enter(phase next_phase, uint32_t due_in_ms)
{
    boot.phase = next_phase;
    boot.due_ms = hal_ms() + due_in_ms;
}

/* True for a time up to 2^31 ms ago, correct across the overflow of hal_ms. */
static bool is_due(void)
{
    return hal_ms() - boot.due_ms < 0x80000000u;
}

static void announce(void)
{
    boot.versions = 0;
    enter(ANNOUNCING, 0);
}

void boot_start(void)
{
    boot.has_application = store_has_application();
    announce();
}

/* NAK with the number of the next packet, or of the last one. */
static void refuse(void)
{
    report_number(REPORT_NAK, boot.next > boot.packets ? boot.packets : boot.next);
}

/* -- messages --------------------------------------------------------------------------------- */

static bool same(const uint8_t *data, const char *text, unsigned size)
{
    for (unsigned i = 0; i < size; ++i)
        if (data[i] != (uint8_t)text[i])
            return false;
    return true;
}

static void on_update(const uint8_t *data)
{
    const uint32_t size = get32(data + 7);
    if (!same(data, UPDATE_NAME, 7) || size == 0 || size > APPLICATION_BYTES)
        return; /* before anything is erased */
    if (boot.phase == ERASING && size == boot.size)
        return; /* repeated: one request answers both */
    if (boot.phase == TRANSFER && size == boot.size && boot.next == 1) {
        report_number(REPORT_REQUEST, 0); /* repeated: already erased */
        enter(TRANSFER, PAUSE_MS);
        return;
    }
    boot.size = size;
    boot.packets = (uint16_t)((size + PACKET_BYTES - 1) / PACKET_BYTES);
    boot.erase_step = 0;
    boot.has_application = false;
    enter(ERASING, 0);
}

static void on_packet(const uint8_t *data)
{
    const uint16_t number = get16(data + 1);
    if (boot.phase != TRANSFER)
        return;
    enter(TRANSFER, PAUSE_MS);
    if (data[0] != SOH || get16(data + 3) != boot.packets || number == 0 || number > boot.next ||
        number > boot.packets) {
        refuse();
        return;
    }
    if (number == boot.next) {
        const uint32_t offset = (number - 1u) * PACKET_BYTES;
        const uint32_t left = boot.size - offset;
        const uint32_t size = left < PACKET_BYTES ? left : PACKET_BYTES;
        if (!store_write(offset, data + 5, size)) {
            refuse();
            announce(); /* written flash cannot be written again without an erase */
            return;
        }
        boot.crc = crc_add(boot.crc, data + 5, size);
        ++boot.next;
    }
    report_number(REPORT_ACK, number); /* also of an older packet, whose ACK was lost */
}

static void on_end(const uint8_t *data)
{
    if (boot.phase != TRANSFER)
        return;
    enter(TRANSFER, PAUSE_MS);
    if (data[0] != EOT || boot.next <= boot.packets) {
        refuse();
        return;
    }
    boot.has_application = store_finish(boot.size, boot.crc);
    if (boot.has_application) {
        report_number(REPORT_COMPLETE, 0);
        enter(STARTING, DRAIN_MS);
    } else {
        refuse();
        announce();
    }
}

static void on_message(void)
{
    const uint8_t *data = message_data(&boot.receiver);
    if (message_mode(&boot.receiver) != MODE_WRITE || boot.phase >= STARTING)
        return;
    switch (message_command(&boot.receiver)) {
    case COMMAND_UPDATE:
        on_update(data);
        break;
    case COMMAND_PACKET:
        on_packet(data);
        break;
    case COMMAND_END:
        on_end(data);
        break;
    case COMMAND_RESET:
        if (RESET_RESTARTS && same(data, "RESET", 5))
            enter(RESTARTING, DRAIN_MS);
        break;
    default: /* commands of the application */
        break;
    }
}

/* A message of the transfer arrived damaged or incomplete. */
static void on_damage(void)
{
    const uint16_t command = message_command(&boot.receiver);
    if (boot.phase == TRANSFER && message_mode(&boot.receiver) == MODE_WRITE &&
        (command == COMMAND_PACKET || command == COMMAND_END))
        refuse();
}

void boot_receive(const can_frame *frame)
{
    if (frame->extended || frame->remote || frame->id != ID_RECEIVED || frame->length == 0 ||
        frame->length > 8)
        return;
    switch (message_receive(&boot.receiver, frame, hal_ms())) {
    case RECEIVED_MESSAGE:
        on_message();
        break;
    case RECEIVED_DAMAGED:
        on_damage();
        break;
    case RECEIVED_NOTHING:
        break;
    }
}

/* -- main loop -------------------------------------------------------------------------------- */

static void send_version(void)
{
    static const uint8_t version[] = OWN_NAME BOOT_VERSION;
    report(REPORT_VERSION, version);
    ++boot.versions;
    enter(ANNOUNCING, boot.versions < VERSIONS ? VERSION_SPACING_MS : WINDOW_MS);
}

static void erase(void)
{
    if (!store_erase(boot.erase_step)) {
        announce();
    } else if (++boot.erase_step == STORE_ERASE_STEPS) {
        boot.next = 1;
        boot.crc = CRC_START;
        report_number(REPORT_REQUEST, 0);
        enter(TRANSFER, PAUSE_MS);
    }
}

uint32_t boot_poll(void)
{
    if (message_expired(&boot.receiver, hal_ms()))
        on_damage();
    switch (boot.phase) {
    case ANNOUNCING:
        if (!is_due())
            break;
        if (boot.versions < VERSIONS)
            send_version();
        else if (boot.has_application)
            enter(STARTING, DRAIN_MS);
        else
            announce();
        break;
    case ERASING:
        erase();
        break;
    case TRANSFER:
        if (is_due())
            announce();
        break;
    case STARTING:
        if ((boot.queued == 0 && hal_sent_all()) || is_due())
            hal_start_application();
        break;
    case RESTARTING:
        if ((boot.queued == 0 && hal_sent_all()) || is_due())
            hal_reset();
        break;
    }
    if (boot.phase == ERASING || is_due())
        return 0;
    if (boot.phase >= STARTING)
        return 1;
    const uint32_t left = boot.due_ms - hal_ms();
    return boot.receiver.have > 0 && left > INTER_FRAME_MS ? INTER_FRAME_MS + 1 : left;
}
