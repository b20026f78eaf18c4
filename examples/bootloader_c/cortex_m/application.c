/* A minimal BMS application: answers version and memory queries and RESET. */
#include "board.h"
#include "message.h"

#ifndef APPLICATION_VERSION
#define APPLICATION_VERSION "V1r0r0_20260101"
#endif

enum {
    ID_RECEIVED = 0x752,
    ID_SENT = 0x725,
    ID_BROADCAST = 0x720,
    READ_VERSION = 0x3300,
    READ_MEMORY = 0x4308,
    WRITE_RESET = 0x4205,
    REPORT_VERSION = 0x1540,
    REPORT_FEEDBACK = 0x5503,
    REPORT_MEMORY = 0x5688,
    MEMORY_BYTES = 128, /* of one answer */
    FLASH_END = 0x20000,
};

static void report(uint16_t id, uint16_t command, const uint8_t *data)
{
    static uint8_t bytes[MESSAGE_MAX_BYTES];
    const uint16_t size = message_make(bytes, id, MODE_REPORT, command, data);
    for (uint16_t at = 0; at < size; at = (uint16_t)(at + 8)) {
        can_frame frame = {.id = id, .length = (uint8_t)(size - at < 8 ? size - at : 8)};
        for (uint8_t i = 0; i < frame.length; ++i)
            frame.data[i] = bytes[at + i];
        board_send(&frame);
    }
}

static void report_version(void)
{
    /* A text ends with a full stop and is padded with spaces to 16 bytes. */
    static const uint8_t version[] = "EXAMPLE.        "
                                     "0.              "
                                     "A0.             "
                                     APPLICATION_VERSION ".";
    _Static_assert(sizeof version == 65, "APPLICATION_VERSION has the form Vxrxrx_YYYYMMDD");
    report(ID_BROADCAST, REPORT_VERSION, version);
}

static void report_memory(const uint8_t *range)
{
    static uint8_t data[8 + MEMORY_BYTES];
    const uint32_t start = get32(range), end = get32(range + 4);
    if (start >= end || end > FLASH_END || end - start > MEMORY_BYTES)
        return;
    put32(data, start);
    put32(data + 4, end);
    for (uint32_t i = 0; i < MEMORY_BYTES; ++i)
        data[8 + i] = i < end - start ? *(const volatile uint8_t *)(start + i) : 0xFF;
    report(ID_SENT, REPORT_MEMORY, data);
}

static bool is_reset(const uint8_t *data)
{
    static const char text[5] = {'R', 'E', 'S', 'E', 'T'};
    for (unsigned i = 0; i < sizeof text; ++i)
        if (data[i] != (uint8_t)text[i])
            return false;
    return true;
}

static void on_message(const message_receiver *receiver)
{
    const uint8_t *data = message_data(receiver);
    const uint16_t command = message_command(receiver);
    if (message_mode(receiver) == MODE_READ && command == READ_VERSION) {
        report_version();
    } else if (message_mode(receiver) == MODE_READ && command == READ_MEMORY) {
        report_memory(data);
    } else if (message_mode(receiver) == MODE_WRITE && command == WRITE_RESET && is_reset(data)) {
        report(ID_SENT, REPORT_FEEDBACK, (const uint8_t *)"ACK");
        while (!board_sent_all()) {
        }
        board_reset();
    }
}

int main(void)
{
    static message_receiver receiver;
    can_frame frame;
    board_start();
    for (;;) {
        if (!board_receive(&frame))
            board_sleep();
        else if (frame.id == ID_RECEIVED && !frame.extended && !frame.remote && frame.length > 0 &&
                 message_receive(&receiver, &frame, board_ms()) == RECEIVED_MESSAGE)
            on_message(&receiver);
    }
}
