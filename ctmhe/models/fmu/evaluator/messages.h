/* What FMUs say: FMI 2 passes a printf format with arguments. */
#ifndef CTMHE_MESSAGES_H
#define CTMHE_MESSAGES_H

#include <ctype.h>
#include <stdarg.h>
#include <stdio.h>
#include <string.h>

/* Whether every % begins a conversion that tools use. Some pass ready texts as formats: a stray % would read arguments
 * that are not there. So no %n, no space flag ("100% sure"), no fields of more than three digits. */
static int is_format(const char *text) {
  for (const char *at = strchr(text, '%'); at; at = strchr(at + 1, '%')) {
    at++;
    at += strspn(at, "-+#0");
    for (int part = 0; part < 2; part++) { /* width, precision */
      if (part && *at != '.') break;
      at += part;
      if (*at == '*') at++;
      else
        for (int digits = 0; isdigit((unsigned char)*at); digits++, at++)
          if (digits == 3) return 0;
    }
    at += strspn(at, "hlzjt");
    if (*at == '\0' || !strchr("diouxXcsfFeEgGaAp%", *at)) return 0;
  }
  return 1;
}

static void write_message(char *buffer, size_t size, const char *text, va_list rest) {
  if (is_format(text)) vsnprintf(buffer, size, text, rest);
  else snprintf(buffer, size, "%s", text);
}

#endif
