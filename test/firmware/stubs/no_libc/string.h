// What the headers take of a C library, for a compiler that comes without one.

#ifndef STUB_STRING_H
#define STUB_STRING_H

#include <stddef.h>

extern "C" {
void* memcpy(void* to, const void* from, size_t size);
void* memmove(void* to, const void* from, size_t size);
int memcmp(const void* a, const void* b, size_t size);
size_t strlen(const char* text);
}

#endif
