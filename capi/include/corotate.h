/* libcorotate: a role of a corotate run in C or C++. Made by cbindgen from capi/src/lib.rs. */

#ifndef COROTATE_H
#define COROTATE_H

#include <stddef.h>
#include <stdint.h>

/*
 The version of this interface. A library of another version may have other functions or other meanings.
 */
#define COROTATE_ABI_VERSION 1

/*
 The call succeeded; for `corotate_seat_wait`, the run has ended.
 */
#define COROTATE_OK 0

/*
 `corotate_seat_wait`: a tick is under way.
 */
#define COROTATE_TICK 1

/*
 `corotate_seat_read`: the sample of this tick is missing or was rejected.
 */
#define COROTATE_MISSING 2

/*
 An argument is null, or a text is not UTF-8.
 */
#define COROTATE_BAD_ARGUMENT -1

/*
 The seat is not open.
 */
#define COROTATE_CLOSED -2

/*
 Another thread uses the seat.
 */
#define COROTATE_BUSY -3

/*
 The call is not possible now: no tick is under way, or the run has ended.
 */
#define COROTATE_WRONG_ORDER -4

/*
 The seat does not exist, or cannot be read.
 */
#define COROTATE_NO_SEAT -5

/*
 The run's program cannot be started.
 */
#define COROTATE_CANNOT_START -6

/*
 The role has no signal or input of this name.
 */
#define COROTATE_NO_SUCH_NAME -7

/*
 The size is not that of the sample, or the count is not that of the input.
 */
#define COROTATE_WRONG_SIZE -8

/*
 The run has ended with an error.
 */
#define COROTATE_RUN_FAILED -9

/*
 A defect of this library.
 */
#define COROTATE_DEFECT -10

/*
 The number of a seat; never 0.
 */
typedef uint64_t corotate_seat;

#ifdef __cplusplus
extern "C" {
#endif // __cplusplus

/*
 Returns the version of this interface.
 */
uint32_t corotate_abi_version(void);

/*
 Returns the sentence about this thread's last call that failed. It is valid until this thread's next call.
 */
const char *corotate_last_error(void);

/*
 Takes the seat of a role and writes its number to `seat`. `path` is the seat's file, which the waiting run prints, or the directory
 of the run; both texts end with NUL.

 # Safety
 The pointers are null or point to objects of their types.
 */
int corotate_seat_open(const char *path,
                       const char *role,
                       corotate_seat *seat);

/*
 Sends the outputs of the tick under way, if there is one, and waits for the next. Returns `COROTATE_TICK`, or `COROTATE_OK` at the end
 of the run. Outputs that are not written are zero, except `valid`, whose bits are set.
 */
int corotate_seat_wait(corotate_seat seat);

/*
 Writes the tick under way to `tick`, and its time since tick 0 in seconds to `time_s`; either may be null.

 # Safety
 The pointers are null or point to objects of their types.
 */
int corotate_seat_tick(corotate_seat seat,
                       uint64_t *tick,
                       double *time_s);

/*
 Writes the period in seconds to `period_s`, and the last tick to `last_tick`; either may be null.

 # Safety
 The pointers are null or point to objects of their types.
 */
int corotate_seat_grid(corotate_seat seat, double *period_s, uint64_t *last_tick);

/*
 Copies an input of the tick under way, as `estimate` or `follower/measurement`, to `sample`, which has `size` bytes. Returns
 `COROTATE_MISSING`, and leaves `sample` as it is, if the input has no sample.

 # Safety
 `signal` is null or a text that ends with NUL; `sample` is null or has room for `size` bytes.
 */
int corotate_seat_read(corotate_seat seat,
                       const char *signal,
                       void *sample,
                       size_t size);

/*
 Copies `sample`, which has `size` bytes, to an output of the tick under way, as `command` or `follower/command`.

 # Safety
 `signal` is null or a text that ends with NUL; `sample` is null or has `size` bytes.
 */
int corotate_seat_write(corotate_seat seat,
                        const char *signal,
                        const void *sample,
                        size_t size);

/*
 Copies the present numbers of an input of the loop, such as a gain or a reference, to `values`, which has room for `count`.

 # Safety
 `key` is null or a text that ends with NUL; `values` is null or has room for `count` numbers.
 */
int corotate_seat_value(corotate_seat seat,
                        const char *key,
                        double *values,
                        size_t count);

/*
 Ends the run at the tick under way with a reason. `corotate_seat_wait` then returns `COROTATE_RUN_FAILED`.

 # Safety
 `reason` is null or a text that ends with NUL.
 */
int corotate_seat_fail(corotate_seat seat,
                       const char *reason);

/*
 Gives the seat up. During the ticks that ends the run.
 */
int corotate_seat_close(corotate_seat seat);

#ifdef __cplusplus
}  // extern "C"
#endif  // __cplusplus

#endif  /* COROTATE_H */
