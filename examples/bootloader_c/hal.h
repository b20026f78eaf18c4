/* Hardware functions of the bootloader. A port implements them and a main loop:
 *
 *   boot_start();
 *   for (;;) {
 *       if a frame was received: boot_receive(&frame);
 *       boot_poll();
 *       while the controller takes a frame and boot_next_frame(&frame): give it to the controller;
 *   }
 *
 * No function of the bootloader waits for anything but flash memory.
 */
#ifndef HAL_H
#define HAL_H

#include <stdbool.h>
#include <stdint.h>

typedef struct {
    uint32_t id;
    uint8_t length; /* of data, 0 to 8 */
    bool extended;  /* a 29-bit id */
    bool remote;
    uint8_t data[8];
} can_frame;

/* Milliseconds since an arbitrary time; wraps to 0 after 2^32 - 1. */
uint32_t hal_ms(void);

/* True when no frame in the controller is waiting for the bus. */
bool hal_sent_all(void);

/* Offsets count from the first byte of the application. Sizes and offsets of writing are multiples
 * of WRITE_BYTES, those of erasing are sectors. False: the flash memory reports an error. */
void hal_flash_read(uint32_t offset, uint8_t *data, uint32_t size);
bool hal_flash_erase(uint32_t offset);
bool hal_flash_write(uint32_t offset, const uint8_t *data, uint32_t size);

/* These two do not return, and leave peripherals and interrupts in their reset state. */
_Noreturn void hal_start_application(void);
_Noreturn void hal_reset(void);

#endif
