/* Interface of a bootloader compiled for a computer, for `flasher conformance --subject`.
 *
 * The bootloader implements the five functions at the end of this file, and uses the functions of
 * `flasher_host` instead of its hardware. Build it, without changes, as one of these:
 *
 *   a shared library      cc -shared -fPIC *.c -o libboot.so
 *                         flasher conformance -t bms --subject ./libboot.so
 *   a program             cc *.c flasher_dut_process.c -o boot
 *                         flasher conformance -t bms --subject ./boot
 *
 * Time is virtual, in microseconds since the suite started. It only passes between calls and during
 * flash operations. No function may sleep. A watchdog ends a call that does not return.
 *
 * Each start (power-up, reset) is a new process, so RAM only holds what the C start-up code
 * initialises. Power can be cut during every flash operation and between calls.
 *
 * The suite simulates the application, from `start_application` until it is reset.
 */
#ifndef FLASHER_DUT_H
#define FLASHER_DUT_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

/* 2: flash_erase and flash_write report errors. What was built with 1 is tested too, but its flash
 * never fails. */
#define FLASHER_DUT_ABI 2u

/* Number of frames that the CAN controller can hold before the first one is on the bus, like its
 * mailboxes. Further frames wait in the memory of the bootloader. */
enum { FLASHER_TRANSMIT_FRAMES = 3 };

/* A classic CAN data or remote frame. */
typedef struct {
    uint32_t id;      /* 11 bits, 29 when extended */
    uint8_t length;   /* data bytes, 0 to 8; of a remote frame, its length code */
    uint8_t extended; /* 1 for a 29-bit id */
    uint8_t remote;   /* 1 for a remote frame, which has no data */
    uint8_t reserved; /* 0 */
    uint8_t data[8];
} flasher_frame;

/* Properties of the device. All sizes in bytes, all times in microseconds. */
typedef struct {
    uint32_t abi;                /* FLASHER_DUT_ABI */
    uint32_t flash_bytes;        /* flash that the bootloader may use, without its own code */
    uint32_t sector_bytes;       /* erased at once; divides flash_bytes */
    uint32_t write_bytes;        /* written at once, and once only after an erase; divides a sector */
    uint32_t application_offset; /* offset of the first byte of an image in that flash */
    uint32_t application_bytes;  /* the largest image */
    uint32_t erase_us;           /* time to erase a sector, during which the processor stops */
    uint32_t write_us;           /* time to write `write_bytes`, likewise */
    uint32_t receive_frames;     /* frames that the CAN controller buffers until they are read */
    const char *name;            /* for reports */
} flasher_dut_facts;

/* Why the bootloader starts. */
enum { FLASHER_POWER_ON = 0, FLASHER_RESET = 1 };

/* Hardware functions. Offsets count from the start of the flash of `flasher_dut_facts`. Accesses that
 * the flash does not allow fail the case: an address outside, a start or size that is not a multiple
 * of a sector or of `write_bytes`, writing to flash that is not erased.
 *
 * The suite makes some calls fail (case PW-04), as flash memory does that is worn out. A call that
 * reports an error has changed nothing; it may succeed when it is repeated. What is written to a
 * sector after an erase of it failed is combined with its old content (AND), without an error. A bit
 * that stays 1 when it is written, and one that is read wrong, are not reported. */
typedef struct {
    uint64_t (*now_us)(void);
    void (*flash_read)(uint32_t offset, void *data, uint32_t size);
    int (*flash_erase)(uint32_t offset); /* the sector at this offset; 0, else the flash reports an error */
    int (*flash_write)(uint32_t offset, const void *data, uint32_t size); /* likewise */
    uint32_t (*transmit_pending)(void);  /* frames in the controller that are not yet on the bus */
    void (*start_application)(void);     /* does not return; pending frames are lost */
    void (*reset)(void);                 /* likewise */
    void (*log)(const char *text);       /* a line for the report of a failure */
} flasher_host;

/* -- functions of the bootloader -------------------------------------------------------------- */

/* Constant, and valid before flasher_dut_start. */
const flasher_dut_facts *flasher_dut_about(void);

/* The reset vector: called once per process, before all functions but flasher_dut_about. `host`
 * stays valid. */
void flasher_dut_start(const flasher_host *host, uint32_t cause);

/* Receives a frame of any id. flasher_dut_tick is called next. */
void flasher_dut_receive(const flasher_frame *frame);

/* One pass of the main loop. Returns the latest time of the next one; UINT64_MAX when only a frame
 * can change anything. A time that is not later than `now_us` means 1 ms from now. Idle passes, which
 * neither use the flash nor log nor send, are made in a row and cost little. */
uint64_t flasher_dut_tick(uint64_t now_us);

/* Fills `frame` with the next frame to send and returns 1, or returns 0. Called after each pass until
 * it returns 0 or the controller is full; when it has room again, another pass follows. */
int flasher_dut_next_frame(flasher_frame *frame);

#ifdef __cplusplus
}
#endif

#endif
