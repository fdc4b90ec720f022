"""Text files as recorders, their programs and spreadsheets write them: one camera trigger and one laser.

Each layout is written from the makers' published descriptions and from such files, by code that shares nothing with the
readers.
"""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

RATE, EDGES = 2000.0, 12
START = datetime(2024, 5, 14, 10, 15, 2)
Array = NDArray[np.float64]
Writer = Callable[[Array, Array, Array], str]


def signals() -> tuple[Array, Array, Array]:
    """Time, a trigger of twelve edges at 20 Hz, the velocity of a laser driven at 80 Hz."""
    time = np.arange(4000) / RATE
    high = ((time - 0.3) % 0.05 < 0.01) & (time > 0.29) & (time < 0.3 + 0.05 * (EDGES - 0.5))
    noise = np.random.default_rng(1).normal(size=len(time))
    return time, 5.0 * high, np.sin(2 * np.pi * 80.0 * time) + 1e-3 * noise


def rows(*columns: Array, by: str = ",", form: str = "{:.6f}", comma: bool = False) -> str:
    """Rows of numbers."""
    text = "\n".join(by.join(form.format(value) for value in row) for row in zip(*columns, strict=True)) + "\n"
    return text.replace(".", ",") if comma else text


def dated(form: str, by: str, time: Array, *columns: Array, comma: bool = False) -> str:
    """Rows whose first cell is a date and time; `%L` are milliseconds, `%N` tenths of them as well."""
    lines = []
    for index, (t, *values) in enumerate(zip(time, *columns, strict=True)):
        stamp = START + timedelta(microseconds=round(1e6 * t))
        assert index == round(t * RATE)
        cell = stamp.strftime(form.replace("%N", f"{stamp.microsecond // 100:04d}"))
        lines.append(by.join([cell, *(f"{value:.6f}".replace(".", "," if comma else ".") for value in values)]))
    return "\n".join(lines) + "\n"


def _german(t: Array, c: Array, v: Array) -> str:
    head = "Messverstärker;DMP 8\nPrüfer;M. Weiß\nDatum;14.05.2024 10:15:02\nAbtastrate;2000 Hz\n\n"
    return head + "Zeit [s];Kamera [V];Laser [m/s]\n" + rows(t, c, v, by=";", comma=True)


def _catman(t: Array, c: Array, v: Array) -> str:
    head = "HBM catmanEasy\tV4.2.2\nFile\tmessung_0001\nDate\t14.05.2024\nTime\t10:15:02\nChannels\t3\n"
    head += "Sample rate\t2000 Hz\nComment\t\n\n"
    names = "Time  1 - default sample rate [s]\tMX410B CH 1 camera [V]\tMX410B CH 2 laser [m/s]\n"
    return head + names + rows(t, c, v, by="\t")


def _catman_units_below(t: Array, c: Array, v: Array) -> str:
    return "Time 1 (s)\tcamera\tlaser\ns\tV\tm/s\n" + rows(t, c, v, by="\t", comma=True)


def _dewesoft(t: Array, c: Array, v: Array) -> str:
    head = "Dewesoft X3\nData file: C:\\Messung\\0001.dxd\nStart time: 14/05/2024 10:15:02.000\nSample rate: 2000 Hz\n"
    return head + "Duration: 2 s\n\n" + "Time (s);camera (V);laser (m/s)\n" + rows(t, c, v, by=";", comma=True)


def _dewesoft_named(t: Array, c: Array, v: Array) -> str:
    return '"Data1 - Time (s)","AI 1/camera (V)","AI 2/laser (m/s)"\n' + rows(t, c, v)


def _tektronix_beside(t: Array, c: Array, v: Array) -> str:
    head = ["Record Length,4.000000e+03", "Sample Interval,5.000000e-04", "Trigger Point,0.0e+00", ",", ",", ","]
    head += ["Source,CH1", "Vertical Units,V", "Vertical Scale,2.0e+00", "Vertical Offset,0.0e+00"]
    head += ["Horizontal Units,s", "Horizontal Scale,2.5e-01", "Pt Fmt,Y", "Yzero,0.0e+00", "Probe Atten,1.0e+00"]
    lines = [f"{x:.9f},{y:.5f}" for x, y in zip(t, c, strict=True)]
    return "\n".join(f"{head[i] if i < len(head) else ','},,{line}," for i, line in enumerate(lines)) + "\n"


def _tektronix(t: Array, c: Array, v: Array) -> str:
    head = "Model,MSO46\nFirmware Version,1.28.6\n\nWaveform Type,ANALOG,,\nPoint Format,Y,,\nHorizontal Units,s,,\n"
    head += "Horizontal Scale,0.2,,\nHorizontal Delay,0,,\nSample Interval,0.0005,,\nRecord Length,4000,,\n"
    head += "Gating,0.0% to 100.0%,,\nProbe Attenuation,1,1\nVertical Units,V,m/s\nVertical Offset,0,0\n,,\n,,\n"
    return head + "Label,camera,laser\nTIME,CH1,CH2\n" + rows(t, c, v, form="{:.9e}")


def _lecroy(t: Array, c: Array, v: Array) -> str:
    head = "LECROYWR8054,12345,Waveform\nSegments,1,SegmentSize,4000\nSegment,TrigTime,TimeSinceSegment1\n"
    return head + "#1,14-May-2024 10:15:02,0\nTime,Ampl\n" + rows(t, c, form="{:.9e}")


def _keysight(t: Array, c: Array, v: Array) -> str:
    return "x-axis,1,2\nsecond,Volt,Volt\n" + rows(t, c, v, form="{:+.6e}")


def _rigol(t: Array, c: Array, v: Array) -> str:
    lines = [f"{i},{a:.4e},{b:.4e},," for i, (a, b) in enumerate(zip(c, v, strict=True))]
    return "X,CH1,CH2,Start,Increment,\nSequence,Volt,Volt,0.000000e+00,5.000000e-04,\n" + "\n".join(lines) + "\n"


def _pico(t: Array, c: Array, v: Array) -> str:
    return "Time,Channel A,Channel B\n(ms),(V),(V)\n\n" + rows(1e3 * t, c, v)


def _signal_express(t: Array, c: Array, v: Array) -> str:
    head = "channel names:\ncamera - Voltage_0\tlaser - Voltage_1\nstart times:\n"
    head += "5/14/2024 10:15:02.000\t5/14/2024 10:15:02.000\ndt:\n0.000500\t0.000500\ndata:\n"
    return head + rows(c, v, by="\t")


def _labview(t: Array, c: Array, v: Array) -> str:
    stamp = "14.05.2024 10:15:02,000"
    head = f"waveform\t[0]\t[1]\nt0\t{stamp}\t{stamp}\ndelta t\t0,000500\t0,000500\n\ntime\tcamera\tlaser\n"
    return head + dated("%d.%m.%Y %H:%M:%S,%N", "\t", t, c, v, comma=True)


def _polytec(t: Array, c: Array, v: Array) -> str:
    head = "Source File Name:\tlaser.pvd\nPoint Index:\t1\nSignal:\tVib - Velocity\nDomain:\tTime\n\n"
    return head + "Time\tCamera\tVelocity\n[ s ]\t[ V ]\t[ m/s ]\n" + rows(t, c, v, by="\t")


def _yokogawa(t: Array, c: Array, v: Array) -> str:
    head = "Model,DL850\nBlockNumber,1\nTraceName,camera  ,laser   \nBlockSize,4000,4000\nVUnit,V,m/s\n"
    head += "SampleRate,2.0000E+03,2.0000E+03\nHResolution,5.0E-04,5.0E-04\nHUnit,s,s\nDate,2024/05/14,2024/05/14\n"
    head += "Time,10:15:02.0000,10:15:02.0000\n\n"
    return head + "".join(f",{a:.5E},{b:.5E}\n" for a, b in zip(c, v, strict=True))


def _excel(t: Array, c: Array, v: Array) -> str:
    return "sep=;\nZeitstempel;Kamera [V];Laser [m/s]\n" + dated("%d.%m.%Y %H:%M:%S,%N", ";", t, c, v, comma=True)


def _iso(t: Array, c: Array, v: Array) -> str:
    return "Timestamp,camera (V),laser (m/s)\n" + dated("%Y-%m-%dT%H:%M:%S.%NZ", ",", t, c, v)


def _american(t: Array, c: Array, v: Array) -> str:
    return "Date/Time,camera [V],laser [m/s]\n" + dated("%m/%d/%Y %I:%M:%S.%N %p", ",", t, c, v)


def _two_columns(t: Array, c: Array, v: Array) -> str:
    return "Datum;Uhrzeit;Kamera [V];Laser [m/s]\n" + dated("%d.%m.%Y;%H:%M:%S,%N", ";", t, c, v, comma=True)


def _epoch(t: Array, c: Array, v: Array) -> str:
    start = 1715681702000
    lines = (f"{start + 1e3 * x:.1f},{a:.5f},{b:.5f}\n" for x, a, b in zip(t, c, v, strict=True))
    return "timestamp,camera,laser\n" + "".join(lines)


def _rate_above(t: Array, c: Array, v: Array) -> str:
    return "Gerät;QuantumX\nAbtastrate [kHz];2\nWerte;4000\n\nKamera [V];Laser [m/s]\n" + rows(c, v, by=";", comma=True)


def _numpy(t: Array, c: Array, v: Array) -> str:
    return "# recorded by a script\n# time_s camera laser\n" + rows(t, c, v, by=" ", form="{:.9e}")


def _slashes(t: Array, c: Array, v: Array) -> str:
    return "t/s;Kamera/V;Laser/m/s\n" + rows(t, c, v, by=";", comma=True)


def _percent(t: Array, c: Array, v: Array) -> str:
    return "% exported\n% Time(s) camera(V) laser(m/s)\n" + rows(t, c, v, by=" ")


def _transposed_head(t: Array, c: Array, v: Array) -> str:
    lines = (f",{x:.6f},{a:.5f},{b:.5f}\n" for x, a, b in zip(t, c, v, strict=True))
    return "Label,Time,camera,laser\nUnit,s,V,m/s\n" + "".join(lines)


def _rohde_schwarz(t: Array, c: Array, v: Array) -> str:
    return "in s,CH1 in V,CH2 in m/s\n" + rows(t - 0.25, c, v, form="{:.8E}")


def _fixed_width(t: Array, c: Array, v: Array) -> str:
    lines = (f"{x:10.5f}   {a:14.5f}   {b:15.6f}\n" for x, a, b in zip(t, c, v, strict=True))
    return "  Time (s)   Camera top (V)   Laser one (m/s)\n" + "".join(lines)


def _thousands(t: Array, c: Array, v: Array) -> str:
    lines = (f"{1e3 * x:,.4f};{a:,.4f};{b:,.4f}\n" for x, a, b in zip(t, c, v, strict=True))
    text = "".join(lines).replace(",", "_").replace(".", ",").replace("_", ".")
    return "Zeit [ms];Kamera [V];Laser [m/s]\n" + text


def _thousands_by_apostrophes(t: Array, c: Array, v: Array) -> str:
    lines = (f"{1e3 * x:,.4f};{a:.4f};{b:.4f}\n" for x, a, b in zip(t, c, v, strict=True))
    return "Zeit [ms];Kamera [V];Laser [m/s]\n" + "".join(lines).replace(",", "'")


def _quoted_commas(t: Array, c: Array, v: Array) -> str:
    lines = (f'"{x:.6f}"_"{a:.6f}"_"{b:.6f}"\n' for x, a, b in zip(t, c, v, strict=True))
    return "Time [s],Camera [V],Laser [m/s]\n" + "".join(lines).replace(".", ",").replace("_", ",")


def _numbers_only(t: Array, c: Array, v: Array) -> str:
    return rows(t, c, v, by="\t", comma=True)


def _footer(t: Array, c: Array, v: Array) -> str:
    end = "\nMin;-0.1;-1.0\nMax;5.1;1.0\nEnd of data;4000 samples\n"
    return "Fs = 2kS/s\nCamera [V];Laser [m/s]\n" + rows(c, v, by=";") + end


def _four_rows(t: Array, c: Array, v: Array) -> str:
    head = "Time|Camera|Laser\ns|V|m/s\n|10 V|125 mm/s/V\n|top|table\n"
    return head + rows(t, c, v, by="|")


def _days(t: Array, c: Array, v: Array) -> str:
    lines = (f"{45322.5 + x / 86400.0:.10f};{a:.6f};{b:.6f}\n" for x, a, b in zip(t, c, v, strict=True))
    return "Time;Camera (V);Laser (m/s)\n" + "".join(lines).replace(".", ",")


def _fortran(t: Array, c: Array, v: Array) -> str:
    return "  Time_s   camera_V   laser_m/s\n" + rows(t, c, v, by="   ", form="{:.9E}").replace("E", "D")


def _grouped_rate(t: Array, c: Array, v: Array) -> str:
    return "Abtastfrequenz;2.000,0 Hz\n\nKamera <V>;Laser {m/s}\n" + rows(c, v, by=";", comma=True)


def _carriage_returns(t: Array, c: Array, v: Array) -> str:
    return ("Measurement time ms;Camera V;Laser m/s\n".replace(" V", "_V") + rows(1e3 * t, c, v, by=";")).replace(
        "\n", "\r"
    )


LAYOUTS: dict[str, tuple[Writer, str, str]] = {
    # how it is written, encoding, suffix
    "German amplifier": (_german, "latin-1", ".csv"),
    "HBM catman": (_catman, "latin-1", ".txt"),
    "HBM catman, units below": (_catman_units_below, "utf-8", ".csv"),
    "Dewesoft": (_dewesoft, "utf-8-sig", ".csv"),
    "Dewesoft, quoted names": (_dewesoft_named, "utf-8", ".txt"),
    "Tektronix, preamble beside the data": (_tektronix_beside, "utf-8", ".csv"),
    "Tektronix, preamble above": (_tektronix, "utf-8", ".csv"),
    "LeCroy": (_lecroy, "utf-8", ".csv"),
    "Keysight": (_keysight, "utf-8", ".csv"),
    "Rigol": (_rigol, "utf-8", ".csv"),
    "PicoScope": (_pico, "utf-8", ".csv"),
    "NI SignalExpress": (_signal_express, "utf-8", ".txt"),
    "NI LabVIEW": (_labview, "utf-8", ".txt"),
    "Polytec": (_polytec, "latin-1", ".txt"),
    "Yokogawa": (_yokogawa, "utf-8", ".csv"),
    "Excel with dates": (_excel, "utf-8-sig", ".csv"),
    "Excel, Unicode text": (_german, "utf-16", ".txt"),
    "UTF-16 without mark": (_iso, "utf-16-le", ".csv"),
    "ISO dates": (_iso, "utf-8", ".csv"),
    "American dates": (_american, "utf-8", ".csv"),
    "date and time of day": (_two_columns, "utf-8", ".csv"),
    "milliseconds since 1970": (_epoch, "utf-8", ".csv"),
    "rate above the table": (_rate_above, "utf-8", ".csv"),
    "names in a remark": (_numpy, "utf-8", ".dat"),
    "names after percent": (_percent, "utf-8", ".txt"),
    "names beside a label": (_transposed_head, "utf-8", ".csv"),
    "units after slashes": (_slashes, "utf-8", ".csv"),
    "Rohde & Schwarz": (_rohde_schwarz, "utf-8", ".csv"),
    "columns of one width": (_fixed_width, "utf-8", ".txt"),
    "thousands by points": (_thousands, "utf-8", ".csv"),
    "thousands by apostrophes": (_thousands_by_apostrophes, "utf-8", ".csv"),
    "decimal commas in quotes": (_quoted_commas, "utf-8", ".csv"),
    "numbers only": (_numbers_only, "utf-8", ".txt"),
    "statistics below": (_footer, "utf-8", ".csv"),
    "four rows above": (_four_rows, "utf-8", ".txt"),
    "days of a spreadsheet": (_days, "utf-8", ".csv"),
    "Fortran": (_fortran, "utf-8", ".dat"),
    "thousands in the rate": (_grouped_rate, "utf-8", ".csv"),
    "lines that end by CR": (_carriage_returns, "utf-8", ".txt"),
}


def write_layout(folder: Path, layout: str, newline: str = "\r\n") -> Path:
    """Write the file of a layout."""
    writer, encoding, suffix = LAYOUTS[layout]
    path = folder / f"log{suffix}"
    path.write_text(writer(*signals()), encoding=encoding, newline=newline)
    return path
