/* A bootloader compiled for the computer, as `flasher conformance --subject` takes it.
 *
 * The bootloader implements the five functions at the end of this file. In the place of its
 * hardware it uses the functions of `flasher_host`. Two ways lead to the suite, without a change:
 *
 *   a shared library      cc -shared -fPIC *.c -o libboot.so
 *                         flasher conformance -t bms --subject ./libboot.so
 *   a program             cc *.c flasher_dut_process.c -o boot
 *                         flasher conformance -t bms --subject ./boot
 *
 * Time is virtual: it is given in microseconds since the suite began, and passes only between calls,
 * and in flash operations. No function may sleep. A call that does not return is ended by a watchdog.
 *
 * Each start (power, reset) is a new process, so that RAM holds nothing but what the start-up code
 * of C gives it. Power can be cut in every flash operation, and between all calls.
 *
 * The suite plays the application. It runs from `start_application` until it is reset.
 */
#ifndef FLASHER_DUT_H
#define FLASHER_DUT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define FLASHER_DUT_ABI 1u

/* The CAN controller takes so many frames before the first of them is on the bus, as the mailboxes of
 * most do. What more there is to send waits in the memory of the bootloader. */
enum { FLASHER_TRANSMIT_FRAMES = 3 };

/* A classical CAN data or remote frame. */
typedef struct {
    uint32_t id;      /* 11 bits, 29 when extended */
    uint8_t length;   /* data bytes, 0 to 8; of a remote frame, its length code */
    uint8_t extended; /* 1 for a 29-bit id */
    uint8_t remote;   /* 1 for a remote frame, which has no data */
    uint8_t reserved; /* 0 */
    uint8_t data[8];
} flasher_frame;

/* What the suite has to know of the device. All sizes in bytes, all times in microseconds. */
typedef struct {
    uint32_t abi;                /* FLASHER_DUT_ABI */
    uint32_t flash_bytes;        /* all flash that the bootloader may use, without its own code */
    uint32_t sector_bytes;       /* erased at once; divides flash_bytes */
    uint32_t write_bytes;        /* written at once, and once only after an erase; divides a sector */
    uint32_t application_offset; /* where the first byte of an image lies in that flash */
    uint32_t application_bytes;  /* the largest image */
    uint32_t erase_us;           /* time to erase a sector; the processor stands still meanwhile */
    uint32_t write_us;           /* time to write `write_bytes`; the same */
    uint32_t receive_frames;     /* frames that the CAN controller keeps while nobody asks for them */
    const char *name;            /* for reports */
} flasher_dut_facts;

/* Why the bootloader starts. */
enum { FLASHER_POWER_ON = 0, FLASHER_RESET = 1 };

/* The hardware. Offsets count from the beginning of the flash of `flasher_dut_facts`. What the flash
 * does not allow ends the case as a failure: an address outside, a start or a size that is no
 * multiple of a sector or of `write_bytes`, writing what is not erased. */
typedef struct {
    uint64_t (*now_us)(void);
    void (*flash_read)(uint32_t offset, void *data, uint32_t size);
    void (*flash_erase)(uint32_t offset); /* the sector that begins there */
    void (*flash_write)(uint32_t offset, const void *data, uint32_t size);
    uint32_t (*transmit_pending)(void);   /* frames taken by the controller and not yet on the bus */
    void (*start_application)(void);      /* does not return; frames that are pending are lost */
    void (*reset)(void);                  /* the same */
    void (*log)(const char *text);        /* a line for the report of a failure */
} flasher_host;

/* -- what the bootloader implements ----------------------------------------------------------- */

/* Constant, and valid before flasher_dut_start. */
const flasher_dut_facts *flasher_dut_about(void);

/* The reset vector: called once in a process, before all others but flasher_dut_about. `host` stays
 * valid. */
void flasher_dut_start(const flasher_host *host, uint32_t cause);

/* A frame was received, of any id. flasher_dut_tick follows. */
void flasher_dut_receive(const flasher_frame *frame);

/* One turn of the main loop. Returns the time of the next one at the latest; UINT64_MAX when only a
 * frame can change anything. A time that is not later than `now_us` means 1 ms from now. */
uint64_t flasher_dut_tick(uint64_t now_us);

/* The next frame to send: fills `frame` and returns 1, or returns 0. Called behind each turn, until it
 * returns 0 or the controller is full; a turn follows when that has room again. */
int flasher_dut_next_frame(flasher_frame *frame);

#ifdef __cplusplus
}
#endif

#endif
