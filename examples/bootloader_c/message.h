/* Messages, and the CAN frames that they are sent in. */
#ifndef MESSAGE_H
#define MESSAGE_H

#include "hal.h"

enum {
    MESSAGE_MAX_BYTES = 264,
    MESSAGE_AROUND_BYTES = 9, /* all but command and data: header, mode, length, CRC, tail */
    MODE_READ = 0x11,
    MODE_WRITE = 0x16,
    MODE_REPORT = 0x0C,
};

/* Puts the messages of one id together. All zero: nothing received. */
typedef struct {
    uint8_t bytes[MESSAGE_MAX_BYTES]; /* not last: a sanitizer would miss an overrun */
    uint16_t have;                    /* bytes received; 0 between messages */
    uint16_t want;
    uint32_t last_ms; /* time of the last frame of the message */
} message_receiver;

typedef enum {
    RECEIVED_NOTHING, /* complete so far */
    RECEIVED_MESSAGE, /* the functions below return its parts, until the next frame */
    RECEIVED_DAMAGED, /* complete, but its tail or its CRC is wrong */
} reception;

/* A data frame of the id. */
reception message_receive(message_receiver *receiver, const can_frame *frame, uint32_t now_ms);

/* Drops a partial message after a pause that is too long; returns true then. */
bool message_expired(message_receiver *receiver, uint32_t now_ms);

static inline uint8_t message_mode(const message_receiver *receiver)
{
    return receiver->bytes[2];
}

/* Its second byte is the size of the data, which was compared with the length. */
static inline uint16_t message_command(const message_receiver *receiver)
{
    return (uint16_t)(receiver->bytes[4] << 8 | receiver->bytes[5]);
}

static inline const uint8_t *message_data(const message_receiver *receiver)
{
    return receiver->bytes + 6;
}

/* Makes a message of data as long as `command` says; returns its size. */
uint16_t message_make(uint8_t *bytes, uint16_t id, uint8_t mode, uint16_t command,
                      const uint8_t *data);

static inline uint16_t get16(const uint8_t *at)
{
    return (uint16_t)(at[0] | at[1] << 8);
}

static inline uint32_t get32(const uint8_t *at)
{
    return get16(at) | (uint32_t)get16(at + 2) << 16;
}

static inline void put32(uint8_t *at, uint32_t value)
{
    for (unsigned i = 0; i < 4; ++i)
        at[i] = (uint8_t)(value >> (8 * i));
}

#endif
