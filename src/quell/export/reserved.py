"""Names that a target has for itself: keywords, macros, functions, headers, files and packages.

A target is what an export is compiled by or read into. The C code is the base of ``c``, ``fmi``
and ``ros2``; a sketch for Arduino, a file in C++ and a package of ROS 2 include its header behind
headers of their own, so names in it are none of their macros either. A name from outside (of an
axis, of a variable of a user's learner) gets an underscore where a word is taken; the name of a
controller, which the user types in his own program, is never changed but refused.

Sources: ISO/IEC 9899:2018 and 9899:2024 (C17, C23), ISO/IEC 14882:2020 (C++20), glibc and newlib,
``Arduino.h`` and ``binary.h`` of the AVR core 1.8, IEC 61131-3:2013 (edition 3) with what CODESYS
and TIA Portal add, REP 144 of ROS, FMI 2.0 and 3.0.
"""

from __future__ import annotations


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


C = _words("""
    auto break case char const continue default do double else enum extern float for goto if
    inline int long register restrict return short signed sizeof static struct switch typedef
    union unsigned void volatile while _Bool _Complex _Imaginary _Alignas _Alignof _Atomic
    _Generic _Noreturn _Static_assert _Thread_local alignas alignof asm bool constexpr false
    nullptr static_assert thread_local true typeof typeof_unqual
""")
"""Keywords of C, to C23; ``asm`` and ``typeof`` are those of compilers before."""
CPP = _words("""
    and and_eq bitand bitor catch char16_t char32_t char8_t class co_await co_return co_yield
    compl concept const_cast consteval constinit decltype delete dynamic_cast explicit export
    friend mutable namespace new noexcept not not_eq operator or or_eq private protected
    public reinterpret_cast requires static_cast template this throw try typeid typename using
    virtual wchar_t xor xor_eq
""")
"""Keywords of C++ that C does not have."""
MACROS = _words("""
    NULL NAN INFINITY EOF errno assert unix linux i386 HUGE_VAL HUGE_VALF HUGE_VALL FP_NAN
    FP_INFINITE FP_ZERO FP_SUBNORMAL FP_NORMAL FP_ILOGB0 FP_ILOGBNAN MATH_ERRNO MATH_ERREXCEPT
    math_errhandling M_E M_LOG2E M_LOG10E M_LN2 M_LN10 M_PI M_PI_2 M_PI_4 M_1_PI M_2_PI
    M_2_SQRTPI M_SQRT2 M_SQRT1_2 M_TWOPI MAXFLOAT OVERFLOW UNDERFLOW DOMAIN SING PLOSS TLOSS
    stdin stdout stderr BUFSIZ SEEK_SET SEEK_CUR SEEK_END EXIT_SUCCESS EXIT_FAILURE RAND_MAX
    CLOCKS_PER_SEC complex imaginary I noreturn near far RANDOM BIG_ENDIAN LITTLE_ENDIAN
    BYTE_ORDER
""")
"""Macros of the headers of C, of POSIX and of compilers, by names that a program may well use."""
ARDUINO = _words("""
    HIGH LOW INPUT OUTPUT INPUT_PULLUP INPUT_PULLDOWN OUTPUT_OPENDRAIN PI HALF_PI TWO_PI
    DEG_TO_RAD RAD_TO_DEG EULER SERIAL DISPLAY LSBFIRST MSBFIRST CHANGE FALLING RISING DEFAULT
    EXTERNAL INTERNAL INTERNAL1V1 INTERNAL2V56 LED_BUILTIN NOT_A_PIN NOT_A_PORT
    NOT_AN_INTERRUPT NOT_ON_TIMER F_CPU ARDUINO A0 A1 A2 A3 A4 A5 A6 A7 SDA SCL SS MOSI MISO
    SCK PA PB PC PD PE PF PG PH PJ PK PL DDRB DDRC DDRD PORTB PORTC PORTD PINB PINC PIND SREG
    SP ADC
""") | {f"B{number:0{digits}b}" for digits in range(1, 9) for number in range(2**digits)}
"""Macros of ``Arduino.h`` that stand alone; ``B0`` to ``B11111111`` are those of ``binary.h``."""
ARDUINO_CALLED = _words("""
    F abs bit bitClear bitRead bitSet bitToggle bitWrite constrain degrees highByte interrupts
    lowByte map max min noInterrupts radians round sq word _BV
""")
"""Macros and functions of ``Arduino.h`` with arguments: only functions can't have their names."""
FUNCTIONS = _words("""
    isnan isinf isfinite isnormal signbit fpclassify isgreater isgreaterequal isless
    islessequal islessgreater isunordered offsetof fma cbrt abs acos asin atan atan2 ceil clear
    copysign cos cosh erf exp fabs floor fmax fmin fmod gamma hypot index j0 j1 jn log log2
    logb main memcpy memset modf pow read remainder remove rename rint round signal sin sinh
    sqrt tan tanh tgamma trunc write y0 y1 yn acosh asinh atanh basename bcmp bcopy bzero drem
    exp2 exp10 expm1 fdim ffs finite frexp ilogb ldexp lgamma llogb llrint llround log10 log1p
    lrint lround memccpy memchr memcmp memmem memmove memrchr mempcpy nan nearbyint nextafter
    nexttoward nextdown nextup pow10 rindex roundeven scalb scalbln scalbn significand sincos
    stpcpy strcat strchr strcmp strcoll strcpy strcspn strdup strerror strlen strncat strncmp
    strncpy strndup strnlen strpbrk strrchr strsep strsignal strspn strstr strtok strxfrm
    getpayload setpayload totalorder canonicalize fmaxmag fminmag fromfp ufromfp issignaling
    iszero iseqsig issubnormal iscanonical
""")
"""Functions and macros with arguments of C libraries; only functions can't have their names."""
HEADERS = _words("""
    algorithm alloca arduino array assert atomic bit complex ctype endian errno features fenv
    float fstream functional inttypes iomanip ios iostream iso646 limits list locale map math
    memory new newlib pthread random regex sched set setjmp signal stack stdalign stdarg
    stdatomic stdbit stdbool stdckdint stddef stdint stdio stdlib stdnoreturn string strings
    tgmath thread threads time tuple uchar unistd utility vector wchar wctype
""")
"""Headers that others include and that a file ``NAME.h`` would hide; in lower case."""
DEVICES = frozenset(("aux", "con", "nul", "prn", *(f"{each}{i}" for each in ("com", "lpt")
                                                  for i in range(1, 10))))  # fmt: skip
"""Devices of Windows, which has no file ``NAME.h`` of such a name; in lower case."""
CMAKE = _words("""
    all all_build clean edit_cache help install list_install_components package package_source
    rebuild_cache run_tests test uninstall zero_check
""")
"""Targets of CMake, or of a program for which it writes; in lower case."""
FMI = frozenset(("fmi2", "fmi3", "fmi3_refused", "model", "refuse"))
"""Files beside those with the name of the model in an FMU."""
ROS2 = _words("""
    ament_cmake controller_interface controller_manager hardware_interface pluginlib rclcpp
    rclcpp_lifecycle realtime_tools std_msgs
""")
"""Packages that an exported package needs."""
IEC = _words("""
    abs abstract acos action add and any any_bit any_char any_chars any_date any_derived
    any_duration any_elementary any_int any_magnitude any_num any_real any_signed any_string
    any_unsigned array asin at atan atan2 begin bit bool bstring by byte case cal calc calcn
    char class concat concat_date concat_date_tod concat_date_ltod configuration constant
    continue cos ctd ctu ctud date date_and_time day_of_week delete dint div divtime do dt
    dword else elsif en end_action end_case end_class end_configuration end_for end_function
    end_function_block end_if end_interface end_method end_namespace end_program end_property
    end_repeat end_resource end_step end_struct end_transition end_type end_union end_var
    end_while eno eq exit exp expt extends f_edge f_trig false final find for from function
    function_block ge goto gt if implements initial_step insert int interface internal
    interval is_valid is_valid_bcd jmp jmpc jmpcn ld ldate ldate_and_time ldn ldt le left len
    limit lint ln log lower_bound lreal lt ltime ltime_of_day ltod lword max method mid min
    mod move mul multime mux namespace ne non_retain not null of on or overlap override
    pointer priority private program property protected public r_edge r_trig read_only
    read_write real ref ref_to reference region end_region repeat replace resource ret retain
    return right rol ror round rs s1 sel shl shr sin single sint split_date split_dt split_tod
    sqrt sr st step stn string struct sub super tan task then this time time_of_day to tod tof
    ton tp transition true trunc type udint uint ulint union until upper_bound using usint
    ustring var var_access var_config var_external var_generic var_global var_in_out var_input
    var_inst var_output var_stat var_temp wchar while with word wstring xor xorn andn orn adr
    adrinst bitadr ini sizeof indexof lstring persistent xint uxint xword variant void
    any_type data_block organization_block tag label const volatile
""")
"""Keywords, types and standard functions of IEC 61131-3; they are the same in capitals."""

_KEYWORD, _ST_KEYWORD = "keyword of C or C++", "keyword of Structured Text"
# What the name of a controller is not, by target. In C it is the beginning of longer names, so that
# ``PI`` and ``HIGH`` are good names; it stands alone as the name of files, of a target of CMake, of
# a package and of a function block. The flag says whether capitals make no difference.
_CONTROLLERS: dict[str, tuple[tuple[str, frozenset[str], bool], ...]] = {
    "C": (
        (_KEYWORD, C | CPP, False),
        ("name that C programs have", frozenset({"NULL", "main"}), False),
        ("standard header of C, C++ or Arduino, which its file would hide", HEADERS, True),
        ("device of Windows, which has no file of this name", DEVICES, True),
    ),
    "CMake": (("target of CMake itself", CMAKE, True),),
    "FMI": (("file that each FMU has", FMI, True),),
    "ROS 2": (("package that this one needs", ROS2, False),),
    "Structured Text": ((_ST_KEYWORD, IEC, True),),
}


def is_taken_in_c(name: str) -> bool:
    """Return whether a variable, a field or a parameter in exported C can't have a name."""
    return any(name in words for words in (C, CPP, MACROS, ARDUINO))


def is_taken_by_function(name: str) -> bool:
    """Return whether a function in exported C can't have a name."""
    return is_taken_in_c(name) or name in FUNCTIONS or name in ARDUINO_CALLED


def is_taken_in_st(name: str) -> bool:
    """Return whether a variable in Structured Text can't have a name, in any spelling."""
    return name.lower() in IEC


def objection(name: str, target: str) -> str:
    """Return why an export can't have the name of a controller, and what to do; or nothing.

    Parameters
    ----------
    name
        an identifier.
    target
        ``"C"``, ``"CMake"``, ``"FMI"``, ``"ROS 2"`` or ``"Structured Text"``.
    """
    for what, words, spelled in _CONTROLLERS[target]:
        if (name.lower() if spelled else name) in words:
            article = "an" if what[0] in "aeiou" else "a"
            return f"name = {name!r}: is {article} {what} (target {target}); choose another name"
    return ""
