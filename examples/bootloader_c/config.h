/* Settings of the product. The compiler can override each value (-DSECTOR_BYTES=1024). */
#ifndef CONFIG_H
#define CONFIG_H

/* -- identity --------------------------------------------------------------------------------- */

#define TARGET_WMC 1
#define TARGET_BMS 2
#define TARGET_OBC 3

#ifndef TARGET
#define TARGET TARGET_BMS
#endif

#ifndef BOOT_VERSION
#define BOOT_VERSION "V1.0.0" /* of the bootloader, exactly this form */
#endif

/* -- flash memory, in bytes ------------------------------------------------------------------- */

/* Offsets start with the application. The record that marks the application as complete occupies
 * the sector after it, which nothing else may write. */
#ifndef APPLICATION_BYTES
#define APPLICATION_BYTES (118u * 1024u)
#endif
#ifndef SECTOR_BYTES
#define SECTOR_BYTES 2048u /* erased at once */
#endif
#ifndef WRITE_BYTES
#define WRITE_BYTES 8u /* written at once, and once only after an erase; divides 128 */
#endif

/* -- behaviour that the documents leave open, times in ms ------------------------------------- */

/* RESET is a command of the application. 1: it restarts the bootloader too. 0: ignored. */
#ifndef RESET_RESTARTS
#define RESET_RESTARTS 0
#endif

/* The protocol sends no checksum of the whole image. 1: each image ends with one, the CRC-32 of all
 * before it (that of zip, low byte first), and an image with a wrong checksum is rejected. */
#ifndef IMAGE_CHECKSUM
#define IMAGE_CHECKSUM 0
#endif

/* How long to wait for an update command after the last boot version of a burst. */
#ifndef WINDOW_MS
#define WINDOW_MS 200u
#endif

/* Longest pause in a transfer. The tool may repeat a packet five times at intervals of 500 ms; a
 * shorter limit would end transfers that can still succeed. */
#ifndef PAUSE_MS
#define PAUSE_MS 4000u
#endif

/* Longest gap between two frames of a message. */
#ifndef INTER_FRAME_MS
#define INTER_FRAME_MS 100u
#endif

/* How long the last frames may wait for the bus before the application starts without them: no node
 * acknowledges frames of a device that is alone on the bus, and it has to start anyway. */
#ifndef DRAIN_MS
#define DRAIN_MS 200u
#endif

#endif
