#include "message.h"

#include "config.h"
#include "crc.h"

/* Covers the header, the id (high byte first), and the mode to the last data byte. */
static uint32_t message_crc(const uint8_t *bytes, uint16_t size, uint32_t id)
{
    const uint8_t around[4] = {bytes[0], bytes[1], (uint8_t)(id >> 8), (uint8_t)id};
    return crc_add(crc_add(CRC_START, around, 4), bytes + 2, size - 7u);
}

/* A message starts with a frame, which is full since the shortest message has 11 bytes. */
static bool begins_message(const can_frame *frame)
{
    const uint8_t *data = frame->data;
    return frame->length == 8 && data[0] == 0x55 && data[1] == 0xAA && data[3] >= 2 &&
           data[5] == data[3] - 2;
}

bool message_expired(message_receiver *receiver, uint32_t now_ms)
{
    if (receiver->have == 0 || now_ms - receiver->last_ms <= INTER_FRAME_MS)
        return false;
    receiver->have = 0;
    return true;
}

reception message_receive(message_receiver *receiver, const can_frame *frame, uint32_t now_ms)
{
    (void)message_expired(receiver, now_ms);
    if (receiver->have == 0) {
        if (!begins_message(frame))
            return RECEIVED_NOTHING;
        receiver->want = (uint16_t)(frame->data[3] + MESSAGE_AROUND_BYTES);
    }
    receiver->last_ms = now_ms;
    for (uint8_t i = 0; i < frame->length && receiver->have < receiver->want; ++i)
        receiver->bytes[receiver->have++] = frame->data[i];
    if (receiver->have < receiver->want) {
        if (frame->length < 8)
            receiver->have = 0; /* only the last frame is shorter */
        return RECEIVED_NOTHING;
    }
    const uint8_t *check = receiver->bytes + receiver->want - 5;
    const uint32_t crc = message_crc(receiver->bytes, receiver->want, frame->id);
    receiver->have = 0;
    for (unsigned i = 0; i < 4; ++i)
        if (check[i] != (uint8_t)(crc >> (24 - 8 * i)))
            return RECEIVED_DAMAGED;
    return check[4] == 0xF0 ? RECEIVED_MESSAGE : RECEIVED_DAMAGED;
}

uint16_t message_make(uint8_t *bytes, uint16_t id, uint8_t mode, uint16_t command,
                      const uint8_t *data)
{
    const uint8_t data_bytes = (uint8_t)command;
    const uint16_t size = (uint16_t)(data_bytes + 2 + MESSAGE_AROUND_BYTES);
    bytes[0] = 0x55;
    bytes[1] = 0xAA;
    bytes[2] = mode;
    bytes[3] = (uint8_t)(data_bytes + 2);
    bytes[4] = (uint8_t)(command >> 8);
    bytes[5] = data_bytes;
    for (uint8_t i = 0; i < data_bytes; ++i)
        bytes[6 + i] = data[i];
    const uint32_t crc = message_crc(bytes, size, id);
    for (unsigned i = 0; i < 4; ++i)
        bytes[6 + data_bytes + i] = (uint8_t)(crc >> (24 - 8 * i));
    bytes[size - 1] = 0xF0;
    return size;
}
