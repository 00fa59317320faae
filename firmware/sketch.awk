# The .ino files of a sketch -> one C++ file, as the IDE makes it: Arduino.h, and the prototype of each function
# before the first one. A function counts if its definition begins on one line.

{
    line[++lines] = $0
    where[lines] = FNR == 1 ? "#line 1 \"" FILENAME "\"\n" : ""
    if ($0 ~ /^[A-Za-z_][A-Za-z_0-9 \t*&:<>,]*[ \t*&][A-Za-z_][A-Za-z_0-9]*\([^;{}=]*\)[ \t]*(\{.*)?$/ &&
        $0 !~ /^(struct|class|enum|union|typedef|using|namespace|template|extern|else|return)[^A-Za-z_0-9]/ &&
        previous !~ /^template/) {
        if (!first) first = lines
        prototypes = prototypes substr($0, 1, match($0, /\)[ \t]*(\{.*)?$/)) ";\n"
    }
    if ($0 !~ /^[ \t]*$/) previous = $0
    if (FNR == 1) file = FILENAME
    number[lines] = FNR
    files[lines] = file
}

END {
    print "#include <Arduino.h>"
    for (i = 1; i <= lines; ++i) {
        if (i == first) printf "%s#line %d \"%s\"\n", prototypes, number[i], files[i]
        printf "%s%s\n", where[i], line[i]
    }
}
