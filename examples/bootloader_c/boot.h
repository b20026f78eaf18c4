/* The upgrade protocol (Welling V1.0.0, chapter 5), as the device speaks it. */
#ifndef BOOT_H
#define BOOT_H

#include "hal.h"

/* After each reset, before all others. */
void boot_start(void);

/* A frame was received, of any kind. boot_poll follows. */
void boot_receive(const can_frame *frame);

/* One turn: returns after how many milliseconds the next one is due at the latest; sooner is fine. */
uint32_t boot_poll(void);

/* The next frame to send, if there is one. */
bool boot_next_frame(can_frame *frame);

#endif
